"""Outputs that appear whole or not at all: written beside their final names in a hidden folder, then renamed.

The hidden folder holds a lock for as long as its run lives, so that two runs never write the same outputs at once, and
so that what a killed run left behind is told from what a living one is writing. It also says who writes, and how far
that is.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
import socket
import warnings
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any

from beltrami_cli.errors import BusyError, DataError, RefusedError

# In a hidden folder: the lock, the file that stands for it where there are no locks, and who holds it.
_LOCK, _STAND_IN, _WHO = ".lock", ".held", ".running"
# How a file system says that it has no locks: NFS without its lock service, FUSE and SMB.
_NO_LOCKS = (errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS)
# How often the owner of a hidden folder may remove it between two steps of the one who wants it next.
_TRIES = 1000
# Bytes of what is told, padded, so that a shorter phase covers a longer one.
_LINE = 400
# Seconds within which a lock that is about to be given up can be had: its owner only removes some files meanwhile.
_PATIENCE = 0.2

# The hidden folders of stages that are entered, with their locks.
_OPEN: dict[Path, Any] = {}
# Those, and others that may stand empty for a moment, before they are locked and after.
_MADE: set[Path] = set()


def abandon() -> None:
    """Leave no trace of what is being written: for a process that is about to end."""
    for folder in list(_OPEN):
        _give_up(folder)
    for folder in list(_MADE):
        _remove(folder)


def who_writes(mark: Path) -> dict[str, Any] | None:
    """The run that is writing files whose last is `mark`: its "process", "host" and "phase"; None where none tells."""
    try:
        return json.loads((_hidden(Path(mark)) / _WHO).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def is_unfinished(mark: Path) -> bool:
    """True where a run was killed while it put its files in place, of which `mark` is the last."""
    return not mark.exists() and (_hidden(mark) / mark.name).exists()


class Stage:
    """Stands between a run and the final names of its outputs.

        with Stage([volume, mesh, sidecar], overwrite=False, inputs=[psi, data]) as stage:
            write(stage.path(volume))
            ...
            stage.commit()

    finals: every file that the run will write, the last one the mark that it completed (it appears last, and where an
        old one stands it disappears first).
    inputs: files that no output may replace.

    Construction raises RefusedError where an output exists (without `overwrite`), is an input or a folder, stands
    twice in the list, or where its folder is missing or not writable. Entering raises BusyError where another run is
    writing them, on this machine or, where the file system's locks reach so far, on another. Leaving without `commit`
    leaves no trace.
    """

    def __init__(self, finals: Iterable[Path], *, overwrite: bool = False, inputs: Iterable[Path] = ()) -> None:
        self._finals = [Path(final) for final in finals]
        self._inputs = [Path(source) for source in inputs]
        self._overwrite = overwrite
        self._held: list[Path] = []
        self._who: list[int] = []  # files, kept open: phases come often, and opening takes long on a network's disk
        _require_distinct(self._finals)
        # A hidden folder for each folder that is written to, named after the last file that is made there, so that
        # runs which share a folder do not meet in it.
        last = {final.parent.resolve(): final for final in self._finals}
        self._folders = {_hidden(final): final for final in last.values()}
        self._require_free()

    def __enter__(self) -> Stage:
        try:
            for folder, final in self._folders.items():
                _claim(folder, final)
                self._held.append(folder)
            self._require_free()  # another run may have ended since
            for folder in self._held:
                _empty(folder)
                with suppress(OSError):  # a disk that is full is told where outputs are written
                    self._who.append(os.open(folder / _WHO, os.O_WRONLY | os.O_CREAT, 0o644))
            self.tell("starting")
        except BaseException:
            self._clear()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._clear()

    def path(self, final: Path) -> Path:
        """Where to write the file that will be `final`: the same name in the hidden folder beside it."""
        return self._folder(Path(final).parent) / Path(final).name

    def tell(self, phase: str) -> None:
        """Say how far the run is, for `who_writes`."""
        who = json.dumps({"process": os.getpid(), "host": socket.gethostname(), "phase": phase})
        for file in self._who:
            with suppress(OSError):
                os.lseek(file, 0, os.SEEK_SET)
                os.write(file, who.ljust(_LINE).encode())

    def commit(self) -> None:
        """Give every file its final name, in the order given; raises DataError where one is missing or stuck."""
        for final in self._finals:
            if not self.path(final).is_file():
                raise DataError(f"{final}: was announced but not written; nothing was put in place")
        if len(self._finals) > 1:
            self._finals[-1].unlink(missing_ok=True)
        for final in self._finals:
            try:
                os.replace(self.path(final), final)
            except OSError as error:
                raise DataError(f"{final}: cannot be put in place ({error.strerror}); check the disk") from error

    def sweep(self) -> None:
        """Remove what killed runs left of these outputs, unless another run is writing them."""
        for folder, mark in self._folders.items():
            if folder.exists():
                with suppress(RefusedError):
                    _claim(folder, mark)
                    _give_up(folder)

    def _require_free(self) -> None:
        """Raise RefusedError where an output cannot be made, or stands in the way.

        What a run has put in place that was killed before its mark, which still lies in the hidden folder, does not.
        """
        unfinished = bool(self._finals) and is_unfinished(self._finals[-1])
        for final in self._finals:
            _require_free(final, self._overwrite or unfinished, self._inputs)

    def _clear(self) -> None:
        while self._who:
            os.close(self._who.pop())
        while self._held:
            _give_up(self._held.pop())

    def _folder(self, parent: Path) -> Path:
        return next(folder for folder in self._folders if folder.parent == parent.resolve())


def _hidden(final: Path) -> Path:
    return final.parent.resolve() / f".{final.name}.partial"


def _claim(folder: Path, final: Path) -> None:
    """Make the hidden folder of a file, or take over what a killed run left, and hold its lock.

    Raises BusyError where a living run holds it, RefusedError where it cannot be made.
    """
    from filelock import Timeout

    _MADE.add(folder)
    for _ in range(_TRIES):
        made = not folder.exists()
        try:
            folder.mkdir(exist_ok=True)
            _OPEN[folder] = _locked(folder)
            return
        except (FileNotFoundError, FileExistsError):  # its last owner removed the folder just now
            if folder.is_symlink() or folder.is_file():
                break
        except Timeout:
            who = who_writes(final) or {}
            name = f"process {who['process']} on {who['host']}" if who else "of another process"
            raise BusyError(
                f"{final}: another run is writing it ({name}); let that one end, or give another name"
            ) from None
        except OSError as error:
            with suppress(OSError):
                if made:
                    (folder / _LOCK).unlink()
            _remove(folder)
            raise RefusedError(
                f"{folder.parent}: cannot be written to ({error.strerror}); choose another folder for the output"
            ) from error
    raise RefusedError(f"{folder}: cannot be made; remove what stands there, or choose another folder")


def _locked(folder: Path) -> Any:
    """The lock of a hidden folder, held; raises filelock's Timeout where another holds it, else OSError."""
    from filelock import FileLock, SoftFileLock

    lock = FileLock(folder / _LOCK, timeout=_PATIENCE, thread_local=False)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that a system without locks gets a file in their place
            lock.acquire()
    except OSError as error:  # no Timeout, which has no number
        if error.errno not in _NO_LOCKS:
            raise
        lock = SoftFileLock(folder / _STAND_IN, timeout=_PATIENCE, thread_local=False)
        lock.acquire()
    return lock


def _give_up(folder: Path) -> None:
    """Remove a hidden folder whose lock this process holds, the lock last."""
    _empty(folder)
    with suppress(OSError):  # where an open file cannot be removed, the next run takes the folder over
        (folder / _LOCK).unlink()
    _OPEN.pop(folder).release()  # not before: `abandon` may come in between
    _remove(folder)


def _remove(folder: Path) -> None:
    """Remove a hidden folder that is empty: where it is not, another run is in it already."""
    with suppress(OSError):
        folder.rmdir()
    _MADE.discard(folder)


def _empty(folder: Path) -> None:
    for path in list(folder.iterdir()) if folder.is_dir() else []:
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        elif path.name not in (_LOCK, _STAND_IN):
            with suppress(OSError):
                path.unlink()


def _require_distinct(finals: list[Path]) -> None:
    seen: set[Path] = set()
    for final in finals:
        if final.resolve() in seen:
            raise RefusedError(f"{final}: named for two outputs; give each its own file")
        seen.add(final.resolve())


def _require_free(final: Path, overwrite: bool, inputs: list[Path]) -> None:
    if any(_same_file(final, source) for source in inputs):
        raise RefusedError(f"{final}: is an input, and inputs are never changed; choose another name for the output")
    if final.is_dir():
        raise RefusedError(f"{final}: is a folder; expected the name of a file to write")
    if os.path.lexists(final) and not overwrite:
        raise RefusedError(f"{final}: exists already; give another name, or --overwrite to replace it")
    parent = final.parent
    if not parent.is_dir():
        raise RefusedError(f"{final}: its folder {parent} does not exist; create it first, or choose another")
    if not os.access(parent, os.W_OK | os.X_OK):
        raise RefusedError(f"{final}: its folder {parent} cannot be written to; choose another")


def _same_file(first: Path, second: Path) -> bool:
    if first.exists() and second.exists():
        return first.samefile(second)
    return first.resolve() == second.resolve()
