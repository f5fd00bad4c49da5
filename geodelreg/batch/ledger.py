"""The ledger: which pairs there are, and what became of each, in one SQLite file.

Only the driver opens it.  A pair is ``pending``, ``running`` or ``done``; what it ended as is a row
of its own in ``outcomes``, which nothing takes away: a retry adds another.  Everything is written
as it happens, in WAL mode: a killed driver loses nothing, a power cut at most the last moments,
which are then run again.
"""

from __future__ import annotations

import hashlib
import sqlite3
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path

from geodelreg import __version__
from geodelreg.batch.job import Pair, PairResult
from geodelreg.errors import LedgerError
from geodelreg.geotiff.atomic import staged

VERSION = 1
_APPLICATION = 0x67656F64  # "geod", for `file` and for us
_SCHEMA = """
CREATE TABLE batch (name TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE pairs (
    number INTEGER PRIMARY KEY,
    pair TEXT NOT NULL,
    state TEXT NOT NULL DEFAULT 'pending' CHECK (state IN ('pending', 'running', 'done')),
    run INTEGER NOT NULL DEFAULT 1,
    started INTEGER NOT NULL DEFAULT 0,
    outcome TEXT
);
CREATE INDEX unfinished ON pairs (number) WHERE state <> 'done';
CREATE TABLE outcomes (
    number INTEGER NOT NULL REFERENCES pairs,
    run INTEGER NOT NULL,
    outcome TEXT NOT NULL,
    finished TEXT NOT NULL,
    result TEXT NOT NULL,
    PRIMARY KEY (number, run)
);
"""
_AT_ONCE = 256


class Ledger:
    """An open ledger; use it as a context manager, in one thread."""

    def __init__(self, path: Path) -> None:
        self.path = path
        uri = path.absolute().as_uri() + "?mode=rw"
        try:
            self._db = sqlite3.connect(uri, uri=True, isolation_level=None, timeout=30)
        except sqlite3.OperationalError as error:
            raise LedgerError(f"{path} cannot be opened ({error})", "Check the name.") from error
        try:
            self._check_version()
            self._db.execute("PRAGMA journal_mode = WAL")
            self._db.execute("PRAGMA synchronous = NORMAL")
        except BaseException:
            self._db.close()
            raise

    def __enter__(self) -> Ledger:
        return self

    def __exit__(self, *_: object) -> None:
        self._db.close()

    def _check_version(self) -> None:
        try:
            (application,) = self._db.execute("PRAGMA application_id").fetchone()
            (version,) = self._db.execute("PRAGMA user_version").fetchone()
        except sqlite3.DatabaseError as error:
            raise LedgerError(
                f"{self.path} is no ledger ({error})", "Name another file (`ledger`)."
            ) from error
        if application != _APPLICATION:
            raise LedgerError(f"{self.path} is no ledger", "Name another file (`ledger`).")
        if version != VERSION:
            raise LedgerError(
                f"{self.path} is a ledger of version {version}, this geodelreg writes {VERSION}",
                "Go on with the geodelreg that began it, or begin another (`ledger`).",
            )

    @staticmethod
    def check_absent(path: Path) -> None:
        """Refuse to begin a ledger where one is.

        Raises
        ------
        LedgerError
        """
        if path.exists():
            raise LedgerError(
                f"{path} exists",
                "Go on with `resume=True` or `retry`, or begin another (`ledger`).",
            )

    @staticmethod
    def create(path: Path, kind: str, pairs: Iterable[Pair]) -> None:
        """Write a new ledger, whole or not at all.

        Parameters
        ----------
        path : Path
        kind : str
            What is done with the pairs.
        pairs : iterable of Pair
            What it raises goes through.

        Raises
        ------
        OutputExistsError, OutputUnwritableError, FileLockedError
        """
        with staged(path, overwrite=False) as draft, closing(sqlite3.connect(draft)) as db:
            db.execute("PRAGMA journal_mode = OFF")
            db.executescript(_SCHEMA)
            digest = _Digest(kind)
            db.executemany(
                "INSERT INTO pairs (number, pair) VALUES (?, ?)",
                enumerate(map(digest.take, pairs), start=1),
            )
            facts = {
                "pairs": digest.text(),
                "kind": kind,
                "geodelreg": __version__,
                "begun": _now(),
            }
            db.executemany("INSERT INTO batch VALUES (?, ?)", facts.items())
            db.execute(f"PRAGMA application_id = {_APPLICATION}")
            db.execute(f"PRAGMA user_version = {VERSION}")
            db.commit()

    def check_pairs(self, kind: str, pairs: Iterable[Pair]) -> None:
        """Refuse to go on with other pairs than those the ledger was made for.

        Raises
        ------
        LedgerError
        """
        digest = _Digest(kind)
        for pair in pairs:
            digest.take(pair)
        (known,) = self._db.execute("SELECT value FROM batch WHERE name = 'pairs'").fetchone()
        if known != digest.text():
            raise LedgerError(
                f"{self.path} belongs to other pairs, or to the same with other options",
                "Give the manifest and the options that it was begun with, or begin another "
                "(`ledger`).",
            )

    def counts(self) -> Counter[str]:
        """Number of pairs by outcome, and of those that have none as ``unfinished``."""
        rows = self._db.execute(
            "SELECT CASE state WHEN 'done' THEN outcome ELSE 'unfinished' END AS what, count(*) "
            "FROM pairs GROUP BY what"
        )
        return Counter(dict(rows.fetchall()))

    def unfinished(self, retried: Collection[str] = ()) -> Iterator[tuple[int, Pair]]:
        """Numbers and pairs that have no outcome, or one of those to be retried, in order."""
        last = 0
        also = f"OR outcome IN ({', '.join('?' * len(retried))})" if retried else ""
        while rows := self._db.execute(
            f"SELECT number, pair FROM pairs WHERE (state <> 'done' {also}) AND number > ? "
            "ORDER BY number LIMIT ?",
            (*retried, last, _AT_ONCE),
        ).fetchall():
            for last, text in rows:
                yield last, Pair.from_json(text)

    def start(self, number: int) -> None:
        """Note that a pair is on its way to a worker."""
        self._db.execute(
            "UPDATE pairs SET state = 'running', started = started + 1 "
            "WHERE number = ? AND state <> 'done'",
            (number,),
        )

    def finish(self, result: PairResult) -> bool:
        """Note what a pair ended as; False when it had ended before, and nothing changes."""
        with self._db:
            self._db.execute("BEGIN IMMEDIATE")
            done = self._db.execute(
                "UPDATE pairs SET state = 'done', outcome = ? WHERE number = ? AND state <> 'done'",
                (result.outcome, result.number),
            )
            if done.rowcount != 1:
                return False
            self._db.execute(
                "INSERT INTO outcomes SELECT number, run, ?, ?, ? FROM pairs WHERE number = ?",
                (result.outcome, _now(), result.to_json(), result.number),
            )
        return True

    def retry(self, outcomes: Collection[str]) -> int:
        """Let pairs with these outcomes run once more; returns how many."""
        marks = ", ".join("?" * len(outcomes))
        return self._db.execute(
            "UPDATE pairs SET state = 'pending', run = run + 1, outcome = NULL "
            f"WHERE state = 'done' AND outcome IN ({marks})",
            tuple(outcomes),
        ).rowcount

    def results(self, outcome: str = "", most: int = -1) -> Iterator[PairResult]:
        """What the pairs ended as, in their order; those that have not are left out.

        Parameters
        ----------
        outcome : str
            Only those that ended as this, if given.
        most : int
            Number of results; -1 = all.
        """
        rows = self._db.execute(
            "SELECT result FROM pairs JOIN outcomes USING (number, run) "
            "WHERE state = 'done' AND ? IN ('', pairs.outcome) ORDER BY number LIMIT ?",
            (outcome, most),
        )
        for (text,) in rows:
            yield PairResult.from_json(text)

    def owns(self, path: Path) -> bool:
        """Whether a table of this batch was written to `path`."""
        name = ("file " + str(path.absolute()),)
        return self._db.execute("SELECT 1 FROM batch WHERE name = ?", name).fetchone() is not None

    def own(self, path: Path) -> None:
        """Note that a table of this batch goes to `path`."""
        name = ("file " + str(path.absolute()), _now())
        self._db.execute("INSERT OR REPLACE INTO batch VALUES (?, ?)", name)


class _Digest:
    """Fingerprint of a list of pairs."""

    def __init__(self, kind: str) -> None:
        self._hash = hashlib.sha256(kind.encode())

    def take(self, pair: Pair) -> str:
        text = pair.to_json()
        self._hash.update(text.encode() + b"\n")
        return text

    def text(self) -> str:
        return f"sha256:{self._hash.hexdigest()}"


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds")
