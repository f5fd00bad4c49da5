"""What is to become of the files of one run, so that all of them change or none.

Each target's private folder gets a plan, then the first one a mark, ``commit``; only then is
anything put into place.  A plan with the mark is carried out, by whoever comes next if need be;
a plan without it is taken back.  Both can be begun anew at any point.
"""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING

from geodelreg.errors import UnsafeInPlaceError
from geodelreg.geotiff import undo
from geodelreg.geotiff.durable import fsync_folder, fsync_path, unwritable
from geodelreg.geotiff.private import PrivateFolder, private_path
from geodelreg.geotiff.sidecars import belongs

if TYPE_CHECKING:
    from collections.abc import Iterator

logger = logging.getLogger(__name__)

_LARGEST_BYTES = 1 << 24


@dataclass(frozen=True, slots=True)
class Plan:
    """What is to be done to one target.

    Attributes
    ----------
    run : str
        The same in all plans of a run.
    inode : int
        Of the private folder: a plan that came with a copied or unpacked folder is not ours.
    group : list of str
        All targets of the run, the one with the mark first, seen from the folder of this one.
    files : dict of str to bool
        Names of the files to put into place, and whether each replaces one; the target last.
    removed : list of str
        Names of side files that must go.
    edits : int
        When not 0, the target is edited in place: its undo record, one of `files`, then has so
        many edits, and the last is to be made.
    """

    run: str
    inode: int
    group: list[str]
    files: dict[str, bool]
    removed: list[str]
    edits: int

    @classmethod
    def load(cls, folder: PrivateFolder) -> Plan | None:
        """Plan in a folder, if there is one.

        Raises
        ------
        OutputUnwritableError
            It is damaged, or was not made for this folder.
        """
        try:
            data = json.loads(folder.read(folder.plan, _LARGEST_BYTES))
            plan = cls(**{field.name: data[field.name] for field in fields(cls)})
            plan._check(folder)
        except FileNotFoundError:
            return None
        except (ValueError, LookupError, TypeError, RecursionError) as error:
            raise folder.foreign(f"holds a plan that was not made for it ({error})") from error
        return plan

    def _check(self, folder: PrivateFolder) -> None:
        kinds = {"run": str, "inode": int, "group": list, "files": dict, "removed": list}
        for name, kind in {**kinds, "edits": int}.items():
            if type(getattr(self, name)) is not kind:
                raise ValueError(f"{name} is no {kind.__name__}")
        if self.inode != folder.path.stat().st_ino:
            raise ValueError("it comes from another folder")
        for name in (*self.files, *self.removed):
            if not isinstance(name, str) or not belongs(folder.target, name):
                raise ValueError(f"{name!r} is no part of {folder.target.name}")
        if folder.target not in self.targets(folder):
            raise ValueError("it is about other files")

    def targets(self, folder: PrivateFolder) -> list[Path]:
        """All targets of the run."""
        here = folder.target.parent
        return [Path(os.path.normpath(here / str(name))) for name in self.group]

    def save(self, folder: PrivateFolder) -> None:
        """Write the plan, durably."""
        draft = folder.path / "plan.draft"
        draft.write_text(
            json.dumps({field.name: getattr(self, field.name) for field in fields(self)})
        )
        fsync_path(draft)
        for used in (folder.files, folder.replaced):
            used.mkdir(exist_ok=True)
            fsync_folder(used)
        draft.replace(folder.plan)
        fsync_folder(folder.path)

    def carry_out(self, folder: PrivateFolder) -> None:
        """Put everything into place.

        Raises
        ------
        UnsafeInPlaceError
            Another program has changed the raster that was to be edited.
        OSError
        """
        for name in self.removed:
            place = folder.target.with_name(name)
            if os.path.lexists(place):
                place.replace(folder.replaced / name)
        for name, replaces in self.files.items():
            new, place, kept = _places(folder, name)
            if os.path.lexists(new):
                if replaces and not os.path.lexists(kept):
                    _keep(place, kept)
                new.replace(place)
        if self.edits:
            self._edit(folder)
        fsync_folder(folder.target.parent)

    def take_back(self, folder: PrivateFolder) -> None:
        """Make everything as it was.

        Raises
        ------
        OSError
        """
        if self.edits:
            self._undo_edit(folder)
        for name in (*reversed(self.files), *self.removed):
            new, place, kept = _places(folder, name)
            if os.path.lexists(kept):
                kept.replace(place)
            elif not self.files.get(name, True) and not os.path.lexists(new):
                place.unlink(missing_ok=True)
        fsync_folder(folder.target.parent)

    def _edit(self, folder: PrivateFolder) -> None:
        edits = undo.load(folder.target)
        if len(edits) != self.edits or not folder.target.is_file():
            return  # reverted or removed
        with folder.target.open("r+b", buffering=0) as file:
            if edits[-1].state(folder.target, file) is undo.State.FOREIGN:
                raise UnsafeInPlaceError(
                    f"{folder.target} was changed by another program meanwhile", "Try again."
                )
            edits[-1].apply(folder.target, file, folder.scratch)

    def _undo_edit(self, folder: PrivateFolder) -> None:
        """Undo the edit, if its record has been put into place and not yet been taken back."""
        if os.path.lexists(folder.files / undo.record_path(folder.target).name):
            return
        edits = undo.load(folder.target)
        if len(edits) != self.edits or not folder.target.is_file():
            return
        with folder.target.open("r+b", buffering=0) as file:
            if edits[-1].state(folder.target, file) is not undo.State.FOREIGN:
                edits[-1].undo(folder.target, file, folder.scratch)


def publish(plans: Mapping[PrivateFolder, Plan]) -> None:
    """Carry out the plans of a run: all of them, or on any exception none.

    Parameters
    ----------
    plans : dict of PrivateFolder to Plan
        The first folder gets the mark.

    Raises
    ------
    UnsafeInPlaceError, OutputUnwritableError
    """
    commit = next(iter(plans)).commit
    try:
        for folder, plan in plans.items():
            with _telling(folder):
                plan.save(folder)
        with _telling(next(iter(plans))):
            commit.write_bytes(b"")
            fsync_folder(commit.parent)
        for folder, plan in plans.items():
            with _telling(folder):
                plan.carry_out(folder)
    except BaseException:
        with _telling(next(iter(plans))):  # if this fails, the next run finishes the work
            commit.unlink(missing_ok=True)
            fsync_folder(commit.parent)
            for folder, plan in plans.items():
                plan.take_back(folder)
            _drop(plans)
        raise
    with suppress(OSError):  # all is in place; the next run tidies up
        _drop(plans)


def settle(folder: PrivateFolder, held: Mapping[Path, PrivateFolder]) -> None:
    """Finish or take back what a killed process left in a folder, and in others of its run.

    Parameters
    ----------
    folder : PrivateFolder
        Just locked.
    held : dict of Path to PrivateFolder
        Other folders that this process has locked, by target.

    Raises
    ------
    FileLockedError, OutputUnwritableError
    """
    plan = Plan.load(folder)
    if plan is not None:
        with ExitStack() as stack:
            plans = _members(folder, plan, held, stack)
            leader = plan.targets(folder)[0]
            finished = any(one.target == leader and one.commit.exists() for one in plans)
            what = "finishing" if finished else "taking back"
            others = ", ".join(sorted(name.name for name in plan.targets(folder)))
            logger.warning("%s: %s a write that was interrupted (%s)", folder.target, what, others)
            for one, its in plans.items():
                with _telling(one):
                    _settle_one(one, its, finished)
            with _telling(folder):
                _drop(plans)
    with _telling(folder):
        folder.clear()


def _settle_one(folder: PrivateFolder, plan: Plan, finished: bool) -> None:
    if not finished:
        plan.take_back(folder)
        return
    try:
        plan.carry_out(folder)
    except UnsafeInPlaceError as error:
        logger.warning("%s; it is left as it is", error.cause)


def _members(
    folder: PrivateFolder, plan: Plan, held: Mapping[Path, PrivateFolder], stack: ExitStack
) -> dict[PrivateFolder, Plan]:
    """Folders with a plan of the same run, in the order of its group; those not held are locked."""
    found = {}
    for target in plan.targets(folder):
        one = folder if target == folder.target else held.get(target)
        if one is None:
            if not os.path.lexists(private_path(target)):
                continue
            one = PrivateFolder(target)
            stack.callback(one.release)
        its = Plan.load(one)
        if its is not None and its.run == plan.run:
            found[one] = its
    return found


def _drop(plans: Mapping[PrivateFolder, Plan] | Sequence[PrivateFolder]) -> None:
    """Remove the plans, that beside the mark last; stops at the first that cannot be removed."""
    for folder in reversed(list(plans)):
        folder.plan.unlink(missing_ok=True)
        fsync_folder(folder.path)


def _places(folder: PrivateFolder, name: str) -> tuple[Path, Path, Path]:
    """Where a file is made, where it belongs, and where the one that it replaces is kept."""
    return folder.files / name, folder.target.with_name(name), folder.replaced / name


def _keep(place: Path, kept: Path) -> None:
    """Keep a file that will be replaced; where it can be, without a moment of absence."""
    if not place.is_symlink():
        with suppress(OSError):  # not every file system has hard links
            os.link(place, kept)
            return
    with suppress(FileNotFoundError):
        place.replace(kept)


@contextmanager
def _telling(folder: PrivateFolder) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise unwritable(folder.target, error) from error
