"""A run folder: one SQLite database with all that a run leaves behind, and a lock.

- run.sqlite: what the run shares, and per instance the record, what the tool printed, the
  witness that it wrote after ``sat`` and the independent check of that witness
- run.sqlite-journal: SQLite's own, while a harness works here or after it was killed
- lock: held while a harness works here
- results.csv: VNN-COMP's six columns, written at the end

An instance's rows are written in one transaction, so they are all there or none is. The
journal is a rollback journal, not a write-ahead log: a log needs memory shared between all
that read and write, which a network file system does not give. ``synchronous=FULL``: a result
that was stored is there even after the power fails. Readers may come at any time; one that
comes after a harness was killed rolls back what it left half-written.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import sqlite3
import time
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from harness.closing import Closing
from harness.files import sync_folder
from harness.records import Data, Record, RunInfo, WitnessCheck
from racecar.errors import BadInput

DATABASE, LOCK = "run.sqlite", "lock"
#: How long (seconds) to wait for a harness that is just ending.
LOCK_PATIENCE_S = 3.0
#: How long a writer waits for readers, and a reader for a writer.
BUSY_PATIENCE_S = 60.0

#: Marks the file as ours ("ClLp"), and the version of its tables.
_APPLICATION_ID, _VERSION = 0x436C4C70, 1
_TABLES = (
    "CREATE TABLE run (id INTEGER PRIMARY KEY CHECK (id = 1), json TEXT NOT NULL)",
    "CREATE TABLE installs (id INTEGER PRIMARY KEY, failure TEXT, log BLOB NOT NULL)",
    "CREATE TABLE records (instance TEXT PRIMARY KEY, category TEXT NOT NULL, json TEXT NOT NULL)",
    "CREATE TABLE checks (instance TEXT PRIMARY KEY, json TEXT NOT NULL)",
    "CREATE TABLE witnesses (name TEXT PRIMARY KEY, content BLOB NOT NULL)",
    "CREATE TABLE logs (name TEXT PRIMARY KEY, content BLOB NOT NULL)",  # compressed by zlib
    f"PRAGMA application_id = {_APPLICATION_ID}",
    f"PRAGMA user_version = {_VERSION}",
)

SomeData = TypeVar("SomeData", bound=Data)


class RunFolder(Closing):
    """What one run has stored; a context manager that closes the database.

    Only who holds the lock may add; all may read, at any time, from one thread an object.
    Methods raise BadInput where the folder is no run, or cannot be read or written.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._database: sqlite3.Connection | None = None

    @classmethod
    def create(cls, path: Path) -> RunFolder:
        """Make a new, empty run folder; BadInput if there is something at ``path``."""
        try:
            path.mkdir(parents=True)
        except FileExistsError:
            raise BadInput(
                f"{path}: it exists; add --resume to continue it, or give another folder with --out"
            ) from None
        sync_folder(path.parent)
        return cls(path)

    @classmethod
    def open(cls, path: Path) -> RunFolder:
        """Return an existing run; BadInput if there is none at ``path``."""
        try:
            names = {file.name for file in path.iterdir()}
        except OSError as error:
            raise BadInput(f"{path}: not a run folder ({error.strerror})") from None
        # A harness that was killed at once may have left nothing but a lock.
        if DATABASE not in names and names - {LOCK}:
            raise BadInput(f"{path}: not a run folder (it has no {DATABASE})")
        return cls(path)

    def lock(self) -> int:
        """Exclude other harnesses, get ready to write; return the descriptor of the lock.

        The lock ends when every process that holds the descriptor has ended.
        """
        fd = os.open(self.path / LOCK, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            _wait_for(fd, self.path)
            self._prepare()
        except BaseException:
            os.close(fd)
            raise
        return fd

    def _prepare(self) -> None:
        """Make the tables, unless they are there."""
        (self.path / DATABASE).touch()
        with self._errors():
            database = self._open()
            # Kept between transactions: cheaper than a new one, and nothing to be unlinked.
            database.execute("PRAGMA journal_mode = PERSIST")
            database.execute("PRAGMA synchronous = FULL")
            empty = _is_empty(database)
        if empty:
            with self._transaction():
                for statement in _TABLES:
                    database.execute(statement)

    def has_begun(self) -> bool:
        """Whether it is known what the run shares: there is an ``info()``."""
        return bool(self._rows("SELECT 1 FROM run"))

    def info(self) -> RunInfo:
        """Return what the run shares."""
        rows = self._rows("SELECT json FROM run")
        if not rows:
            raise BadInput(f"{self.path}: the run was killed before it began")
        return self._parse(RunInfo, "what the run shares", rows[0][0])

    def write_info(self, info: RunInfo) -> None:
        """Write what the run shares."""
        with self._transaction() as database:
            database.execute("INSERT OR REPLACE INTO run VALUES (1, ?)", (_json(info),))

    def is_installed(self) -> bool:
        """Whether the tool's install_tool.sh has been run, and ended well."""
        return bool(self._rows("SELECT 1 FROM installs WHERE failure IS NULL"))

    def add_install(self, failure: str | None, log: bytes) -> None:
        """Write how install_tool.sh ended, and what it printed."""
        with self._transaction() as database:
            row = (failure, zlib.compress(log))
            database.execute("INSERT INTO installs (failure, log) VALUES (?, ?)", row)

    def install_log(self) -> bytes:
        """Return what install_tool.sh printed when it was last run; BadInput if it never was."""
        rows = self._rows("SELECT log FROM installs ORDER BY id DESC LIMIT 1")
        if not rows:
            raise BadInput(f"{self.path}: no install_tool.sh was run")
        return self._unpacked(rows[0][0])

    def has(self, instance: str) -> bool:
        """Whether there is a record of the instance."""
        return bool(self._rows("SELECT 1 FROM records WHERE instance = ?", instance))

    def instances(self) -> set[str]:
        """Return which instances have a record."""
        return {row[0] for row in self._rows("SELECT instance FROM records")}

    def record(self, instance: str) -> Record:
        """Return the record of an instance; BadInput if there is none."""
        rows = self._rows("SELECT json FROM records WHERE instance = ?", instance)
        if not rows:
            raise BadInput(f"{self.path}: there is no record of an instance {instance}")
        return self._parse(Record, f"record of {instance}", rows[0][0])

    def records(self) -> list[Record]:
        """Return all records, ordered by category and instance."""
        rows = self._rows("SELECT instance, json FROM records ORDER BY category, instance")
        return [self._parse(Record, f"record of {row[0]}", row[1]) for row in rows]

    def witness(self, record: Record) -> bytes:
        """Return what the tool wrote after ``sat``; nothing where it wrote nothing."""
        if record.witness is None:
            return b""
        rows = self._rows("SELECT content FROM witnesses WHERE name = ?", record.witness)
        if not rows:
            raise BadInput(f"{self.path}: the witness {record.witness} is not there")
        return bytes(rows[0][0])

    def check(self, instance: str) -> WitnessCheck | None:
        """Return the stored check of an instance's witness, if there is one."""
        rows = self._rows("SELECT json FROM checks WHERE instance = ?", instance)
        return self._parse(WitnessCheck, f"check of {instance}", rows[0][0]) if rows else None

    def log(self, record: Record) -> bytes:
        """Return what the tool printed (the middle of a long log is left out)."""
        rows = self._rows("SELECT content FROM logs WHERE name = ?", record.log)
        if not rows:
            raise BadInput(f"{self.path}: the log {record.log} is not there")
        return self._unpacked(rows[0][0])

    def write_check(self, check: WitnessCheck) -> None:
        """Write the check of a witness, in the place of one that is there."""
        with self._transaction() as database:
            _insert_check(database, check)

    def add(
        self, record: Record, *, log: bytes, witness: bytes | None, check: WitnessCheck | None
    ) -> Record:
        """Write all that belongs to one result, at once; return the record as it is stored.

        BadInput if the instance has a record.
        """
        name = None if witness is None else record.instance
        record = record.model_copy(update={"witness": name})
        packed = zlib.compress(log)
        with self._transaction() as database:
            row = (record.instance, record.category, _json(record))
            database.execute("INSERT INTO records VALUES (?, ?, ?)", row)
            database.execute("INSERT INTO logs VALUES (?, ?)", (record.log, packed))
            if witness is not None:
                database.execute("INSERT INTO witnesses VALUES (?, ?)", (name, witness))
            if check is not None:
                _insert_check(database, check)
        return record

    def finish(self) -> None:
        """Remove SQLite's journal: the database alone is the whole run."""
        with self._errors():
            self._open().execute("PRAGMA journal_mode = DELETE")

    def close(self) -> None:
        """Close the database; it is opened again when it is needed."""
        if self._database is not None:
            self._database.close()
            self._database = None

    def _open(self) -> sqlite3.Connection:
        """Return the database, opened; it must exist."""
        if self._database is None:
            # Opened for writing by readers too: they may have to roll back. Where they may not
            # write, SQLite opens it for reading.
            address = f"{(self.path / DATABASE).resolve().as_uri()}?mode=rw"
            database = sqlite3.connect(
                address, uri=True, isolation_level=None, timeout=BUSY_PATIENCE_S
            )
            try:
                database.execute("PRAGMA trusted_schema = OFF")
                self._require_ours(database)
            except BaseException:
                database.close()
                raise
            self._database = database
        return self._database

    def _require_ours(self, database: sqlite3.Connection) -> None:
        """BadInput unless it is the database of a run, or empty still."""
        # In one transaction: a harness may be making the tables just now.
        database.execute("BEGIN")
        (mark,), (version,) = (
            database.execute(f"PRAGMA {name}").fetchone()
            for name in ("application_id", "user_version")
        )
        empty = _is_empty(database)
        database.execute("COMMIT")
        if empty:
            return
        if mark != _APPLICATION_ID:
            raise BadInput(f"{self.path}: {DATABASE} is not the database of a run")
        if version != _VERSION:
            raise BadInput(
                f"{self.path}: it was made by another version of the harness "
                f"(version {version} of the database, this one reads {_VERSION})"
            )

    def _rows(self, query: str, *values: str) -> Sequence[Any]:
        """Return the rows that a query finds; none where the run has not begun."""
        if not (self.path / DATABASE).exists():
            return []
        with self._errors():
            database = self._open()
            if _is_empty(database):
                return []
            # All at once: an unfinished query would keep writers waiting.
            return database.execute(query, values).fetchall()

    @contextlib.contextmanager
    def _transaction(self) -> Iterator[sqlite3.Connection]:
        with self._errors():
            database = self._open()
            try:
                database.execute("BEGIN IMMEDIATE")
                yield database
                database.execute("COMMIT")
            finally:
                if database.in_transaction:
                    database.execute("ROLLBACK")

    @contextlib.contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.Error as error:
            raise BadInput(f"{self.path}: {_explain(error)}") from None

    def _unpacked(self, content: bytes) -> bytes:
        try:
            return zlib.decompress(content)
        except zlib.error as error:
            raise BadInput(f"{self.path}: a log in {DATABASE} is damaged ({error})") from None

    def _parse(self, kind: type[SomeData], what: str, text: str) -> SomeData:
        try:
            return kind.model_validate_json(text)
        except ValidationError as error:
            first = error.errors()[0]
            place = ".".join(str(x) for x in first["loc"])
            problem = f"{place + ': ' if place else ''}{first['msg']}"
            raise BadInput(f"{self.path}: {what}: {problem}") from None


def _wait_for(fd: int, path: Path) -> None:
    """Take the lock, at once or as soon as a harness that is just ending lets it go."""
    give_up = time.monotonic() + LOCK_PATIENCE_S
    while True:
        try:
            return fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() > give_up:
                raise BadInput(f"{path}: another harness is working on it") from None
        except OSError as error:
            if error.errno not in (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP):
                raise
            raise BadInput(
                f"{path}: its file system has no locks ({error.strerror}), so a run is not "
                "safe there; give a folder on another with --out"
            ) from None
        time.sleep(0.05)


def _is_empty(database: sqlite3.Connection) -> bool:
    """Whether there is no table yet: a harness was killed before it made them."""
    return not database.execute("SELECT 1 FROM sqlite_schema LIMIT 1").fetchall()


def _insert_check(database: sqlite3.Connection, check: WitnessCheck) -> None:
    row = (check.instance, _json(check))
    database.execute("INSERT OR REPLACE INTO checks VALUES (?, ?)", row)


def _json(data: Data) -> str:
    return data.model_dump_json()


def _explain(error: sqlite3.Error) -> str:
    """Say what is wrong with a database, and what to do."""
    # The least byte is the kind of error; an error of Python's own has no code.
    kind = getattr(error, "sqlite_errorcode", 0) & 0xFF
    return _KINDS.get(kind, f"its database cannot be used ({error})")


_KINDS = {
    sqlite3.SQLITE_FULL: "the disk is full; make room, then go on with --resume",
    sqlite3.SQLITE_BUSY: "another program keeps its database busy; end it, or try again",
    sqlite3.SQLITE_READONLY: (
        "its database may not be written; if its harness was killed, only who may write "
        "can read it: copy the whole folder and use the copy"
    ),
    sqlite3.SQLITE_CONSTRAINT: "the instance has a record already",
    sqlite3.SQLITE_NOTADB: f"{DATABASE} is not a database",
    sqlite3.SQLITE_CORRUPT: f"{DATABASE} is damaged",
}
