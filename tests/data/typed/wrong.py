"""Calls that are wrong: type checkers complain where it says so, and where they do not, of that."""
# pyright: reportUnnecessaryTypeIgnoreComment=true

import geodelreg

alignment = geodelreg.align("ms.tif", "pan.tif")
geodelreg.align("ms.tif", "pan.tif", modl="scale")  # type: ignore[call-arg]
geodelreg.align("ms.tif", "pan.tif", ratio="half")  # type: ignore[arg-type]
geodelreg.write(alignment, "out.tif", overwrite="yes")  # type: ignore[arg-type]
print(alignment.shift)  # type: ignore[attr-defined]
print(alignment.shift_px + 1)  # type: ignore[operator]
