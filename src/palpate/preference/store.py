"""The votes and invitations of a served study, in one SQLite file.

Its key is (rater, trial), so that a vote sent again counts once, and only a later ``undone``
replaces it. Of an invitation a hash is kept.

The file alone is the truth: a vote is in it when it is acknowledged, and no log lies next to it but
while a vote is written. Its header's ``user_version`` counts the votes n, in the same transaction:
n, or -1 - n while a server has the file. Each vote holds its digest, which is checked when it is
read.
"""

from __future__ import annotations

import hashlib
import secrets
import sqlite3
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from palpate.core import PalpateError, digest_lines, require

Vote = Mapping[str, Any]
#: What a vote is, next to its rater.
CELLS = ("trial", "choice", "ms", "at", "undone")
#: What is read of it, and has its digest.
READ = (*CELLS, "rater")
_TABLES = """
PRAGMA synchronous=EXTRA;
CREATE TABLE IF NOT EXISTS study (name TEXT PRIMARY KEY) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS invitations (token TEXT PRIMARY KEY, rater TEXT UNIQUE) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS votes (
    rater TEXT, trial TEXT, choice TEXT, ms INTEGER, at TEXT, undone INTEGER, received TEXT,
    seal TEXT, PRIMARY KEY (rater, trial)
) WITHOUT ROWID;
"""
_STORE = """
INSERT INTO votes VALUES (:rater, :trial, :choice, :ms, :at, :undone, :received, :seal)
ON CONFLICT (rater, trial) DO UPDATE SET choice = excluded.choice, ms = excluded.ms,
    at = excluded.at, undone = excluded.undone, received = excluded.received, seal = excluded.seal
WHERE excluded.undone > votes.undone
"""


class VoteStore:
    """The votes and invitations of one study; used by one thread at a time.

    Args:
        path: the file.
        study: name of the study, which the file keeps.
        mode: ``rwc`` makes the file where there is none, ``ro`` only reads.

    Raises:
        PalpateError: if the file is of another study, or cannot be written or read.
    """

    def __init__(self, path: Path, study: str, mode: str = "rwc") -> None:
        self._path, uri = path, f"{path.absolute().as_uri()}?mode={mode}"
        self._writes = mode != "ro"
        with _usable(path):
            if self._writes:
                path.touch(0o600)  # SQLite gives the file next to it the same rights
            self._disk = sqlite3.connect(
                uri, uri=True, isolation_level=None, check_same_thread=False
            )
            if self._writes:
                self._disk.executescript(_TABLES)
                self._disk.execute("INSERT OR IGNORE INTO study VALUES (?)", (study,))
            names = [name for (name,) in self._disk.execute("SELECT name FROM study")]
        try:
            require_study(path, study, *names)
        except PalpateError:
            self._disk.close()
            raise
        if self._writes:
            with _usable(path):
                self._mark(-1 - self._count())

    def close(self) -> None:
        """Close the file, and say in it that its server has ended."""
        if self._writes:
            self._writes = False
            with suppress(sqlite3.Error):  # a full disk: the file stays open, as a killed server's
                self._mark(self._count())
        self._disk.close()

    def _mark(self, mark: int) -> None:
        self._disk.execute(f"PRAGMA user_version = {mark}")

    def _count(self) -> int:
        return self._disk.execute("SELECT count(*) FROM votes").fetchone()[0]

    def ended(self) -> bool:
        """Whether the server has ended, and the file thus has its last vote.

        Raises:
            PalpateError: if the file has other votes than were counted, or cannot be read.
        """
        with _usable(self._path):
            count, (mark,) = self._count(), self._disk.execute("PRAGMA user_version").fetchone()
        counted = max(mark, -1 - mark)
        must = f"{self._path} must hold all votes, the {counted:,} that its server counted"
        fix = (
            "Copy it after the server has ended. To go on without the others, serve the study and "
        )
        fix += "stop it: it counts anew"
        require(count == counted, None, must, f"{count:,}", fix=fix)
        return mark >= 0

    def invite(
        self, raters: Sequence[str], count: int, again: Sequence[str] = ()
    ) -> dict[str, str]:
        """Make tokens for the next ``count`` raters that have none, and new ones for ``again``.

        Returns:
            Rater -> token, which is kept nowhere.

        Raises:
            PalpateError: if the study has too few raters, or not those named, or the disk is full.
        """
        require(count >= 0, "invite", "must be 0 or more", count, 10)
        for rater in again:
            must = f"must be raters of the study, {raters[0]} to {raters[-1]}"
            require(rater in raters, "reinvite", must, repr(rater), raters[0])
        taken = {*self.raters().values(), *again}
        free = [rater for rater in raters if rater not in taken]
        must = f"must be at most {len(free)}: the study has {len(raters)} raters"
        got, fix = f"{count} more, and {len(taken)} are invited", "Plan a study with more raters"
        require(count <= len(free), "invite", must, got, fix=fix)
        tokens = {rater: secrets.token_urlsafe(16) for rater in [*again, *free[:count]]}
        rows = [(hashed(token), rater) for rater, token in tokens.items()]
        with _usable(self._path):
            self._disk.execute("BEGIN IMMEDIATE")
            self._disk.executemany("INSERT OR REPLACE INTO invitations VALUES (?, ?)", rows)
            self._disk.execute("COMMIT")
        return tokens

    def raters(self) -> dict[str, str]:
        """Hash of a token -> rater."""
        return dict(self._disk.execute("SELECT token, rater FROM invitations").fetchall())

    def store(self, votes: Sequence[Vote]) -> list[bool]:
        """Put votes on disk, all or none; whether each is new.

        Raises:
            sqlite3.OperationalError: if the disk is full.
        """
        self._disk.execute("BEGIN IMMEDIATE")
        try:
            rows = (
                {**vote, "seal": digest_lines(str(vote[name]) for name in READ)} for vote in votes
            )
            new = [self._disk.execute(_STORE, row).rowcount == 1 for row in rows]
            self._mark(-1 - self._count())
            self._disk.execute("COMMIT")
        except BaseException:
            if self._disk.in_transaction:
                self._disk.execute("ROLLBACK")
            raise
        return new

    def votes(self, rater: str) -> list[dict[str, Any]]:
        """The votes of a rater.

        Raises:
            PalpateError: if one is damaged, or they cannot be read.
        """
        with _usable(self._path):
            query = f"SELECT seal, {', '.join(READ)} FROM votes WHERE rater = ?"
            rows = self._disk.execute(query, (rater,)).fetchall()
            if any(seal != digest_lines(map(str, cells)) for seal, *cells in rows):
                raise sqlite3.DataError("a damaged vote")
        return [dict(zip(CELLS, cells, strict=False)) for _, *cells in rows]

    def voters(self) -> list[str]:
        """The raters who voted."""
        with _usable(self._path):
            return [r for (r,) in self._disk.execute("SELECT DISTINCT rater FROM votes")]


@contextmanager
def _usable(path: Path) -> Generator[None]:
    """Raise what SQLite raises inside as an error of the file."""
    try:
        yield
    except (
        sqlite3.Error,
        OSError,
        UnicodeDecodeError,
    ) as error:  # SQLite's message quotes the file
        must = f"{path} must be a file of votes that the server can read and write"
        fix = "Name the one that it wrote; after a kill, serve the study once more and stop it"
        raise PalpateError(must, str(error), fix) from None


def require_study(path: Path, study: str, *names: Any) -> None:
    """Check that votes are of a study.

    Args:
        path: their file, for the error.
        study: name of the study.
        names: what the file says.

    Raises:
        PalpateError: if they are not.
    """
    got, fix = ", ".join(map(str, names)) or "none", "Use the plan that they were given for"
    require(names == (study,), None, f"The votes in {path} must be of study {study}", got, fix=fix)


def hashed(token: str) -> str:
    """A token has 128 random bits, so that a plain hash cannot be turned back."""
    return hashlib.sha256(token.encode()).hexdigest()
