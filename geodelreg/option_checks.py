"""What the values of options may be, asked when they are made; each refusal names the knob.

The functions take the options and the name of the field, and raise `UsageError` for impossible
values, `TypeError` for those of another type.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import Field, field, fields
from numbers import Integral, Real
from typing import Any

from geodelreg.errors import UsageError
from geodelreg.masking import parse_mask

RESAMPLINGS = ("nearest", "bilinear", "cubic", "cubicspline", "lanczos", "average")


def knob(default: Any, help_text: str, choices: tuple[str, ...] = ()) -> Any:
    """A field of options with its documentation."""
    return field(default=default, metadata={"help": help_text, "choices": choices})


def field_of(options: Any, name: str) -> Field[Any]:
    """One field of options, or of their class."""
    return {field.name: field for field in fields(options)}[name]


def knob_help(options: type, name: str) -> str:
    """Help text of one knob of an options class."""
    return str(field_of(options, name).metadata["help"])


def check_choice(options: object, name: str) -> None:
    """Take only what the field lists."""
    spec = field_of(options, name)
    choices, value = spec.metadata["choices"], getattr(options, name)
    if value not in choices:
        raise UsageError(f"`{name}={value!r}` is unknown", f"Use one of: {', '.join(choices)}.")


def check_masks(options: object, name: str) -> None:
    """Check the names of masks, and make paths of any kind strings."""
    value = getattr(options, name)
    if isinstance(value, str | os.PathLike):
        raise UsageError(f"`{name}={value!r}` is one name", "Give a tuple of them.")
    masks = tuple(os.fspath(mask) for mask in value)
    for mask in masks:
        parse_mask(mask)
    object.__setattr__(options, name, masks)


def check_creation(options: object, name: str) -> None:
    """Take only a sequence of ``KEY=VALUE``."""
    given = getattr(options, name)
    if isinstance(given, str | Mapping) or not isinstance(given, Iterable):
        raise TypeError(f"`{name}={given!r}` is no sequence of KEY=VALUE")
    for option in given:
        if not isinstance(option, str) or "=" not in option:
            raise UsageError(f"creation option {option!r} is not KEY=VALUE")


def check_number(options: object, name: str) -> None:
    """Take only numbers, and whole ones for fields of these."""
    spec = field_of(options, name)
    value, is_whole = getattr(options, name), str(spec.type).startswith("int")
    if value is not None and not isinstance(value, Integral if is_whole else Real):
        raise TypeError(f"`{name}={value!r}` is no {'whole ' if is_whole else ''}number")


def keep_list(options: object, name: str) -> None:
    """Keep a sequence of numbers as a tuple; on the command line it is text."""
    value = getattr(options, name)
    if not isinstance(value, str):
        try:
            object.__setattr__(options, name, tuple(value))
        except TypeError:
            raise TypeError(f"`{name}={value!r}` is neither text nor numbers") from None


def listed(value: str | Iterable[Any]) -> list[Any]:
    """The parts of a sequence, or of text with commas."""
    return value.split(",") if isinstance(value, str) else list(value)


def band_numbers(name: str, value: str | Iterable[Any]) -> tuple[int, ...]:
    """Numbers of bands, from 1, out of a sequence or text with commas."""
    texts = [str(each).strip() for each in listed(value)]
    if not all(text.isdecimal() and int(text) > 0 for text in texts):
        raise UsageError(f"`{name}={value!r}` are no bands", "Use numbers such as 1,2,3.")
    return tuple(int(text) for text in texts)


def keep_bands(options: object, name: str) -> None:
    """Keep numbers of two bands or more, or of none, as a tuple."""
    value = getattr(options, name)
    try:
        numbers = band_numbers(name, value) if value else ()
    except TypeError:
        raise TypeError(f"`{name}={value!r}` is neither text nor numbers") from None
    if len(numbers) == 1:
        raise UsageError(f"`{name}={value!r}` is one band", "Name two or more.")
    object.__setattr__(options, name, numbers)


def check_range(options: object, name: str, low: float, high: float) -> None:
    """Take only numbers from `low` to `high`, both included."""
    check_number(options, name)
    value = getattr(options, name)
    if value is not None and not low <= value <= high:
        raise UsageError(f"`{name}={value}` is out of range", f"Use {low:g} to {high:g}.")
