"""Outputs that appear whole or not at all: written beside their final names in a hidden folder, then renamed."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable
from pathlib import Path
from types import TracebackType

from beltrami_cli.errors import DataError, RefusedError

# The hidden folders of stages that are entered.
_OPEN: set[Path] = set()


def abandon() -> None:
    """Leave no trace of what is being written: for a process that is about to end."""
    for folder in list(_OPEN):
        shutil.rmtree(folder, ignore_errors=True)


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
    twice in the list, or where its folder is missing or not writable. Leaving without `commit` leaves no trace.
    """

    def __init__(self, finals: Iterable[Path], *, overwrite: bool = False, inputs: Iterable[Path] = ()) -> None:
        self._finals = [Path(final) for final in finals]
        _require_distinct(self._finals)
        sources = [Path(source) for source in inputs]
        for final in self._finals:
            _require_free(final, overwrite, sources)

    def __enter__(self) -> Stage:
        # A folder of this name is what a killed run left behind.
        self._clear()
        for folder in self._folders():
            try:
                _OPEN.add(folder)
                folder.mkdir()
            except OSError as error:
                self._clear()
                raise RefusedError(
                    f"{folder.parent}: cannot be written to ({error.strerror}); choose another folder for the output"
                ) from error
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._clear()

    def path(self, final: Path) -> Path:
        """Where to write the file that will be `final`: the same name in the hidden folder beside it."""
        return self._folder(Path(final).parent) / Path(final).name

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

    def _clear(self) -> None:
        for folder in self._folders():
            shutil.rmtree(folder, ignore_errors=True)
            _OPEN.discard(folder)

    def _folder(self, parent: Path) -> Path:
        # Named after a file that is made there, so that runs which share a folder do not meet in it.
        first = next(final for final in self._finals if final.parent.resolve() == parent.resolve())
        return parent.resolve() / f".{first.name}.partial"

    def _folders(self) -> list[Path]:
        return list(dict.fromkeys(self._folder(final.parent) for final in self._finals))


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
