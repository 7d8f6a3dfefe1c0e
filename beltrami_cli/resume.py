"""Whether a job has been done already: its outputs are there, from the same inputs, parameters and version."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from beltrami_cli import __version__
from beltrami_cli.config import Job
from beltrami_cli.record import plain, request, seen_from, sha256, sidecar_of, sources_of

# Of a record, what a batch tells of its job.
_FIGURES = {"Noise", "Seconds", "Iterations", "StopReason", "Warnings"}


def finished(job: Job) -> dict[str, Any] | None:
    """The record of an earlier run that `job` would only repeat; None where there is none, or it did something else.

    A run is the same where its sidecar tells of this version, of what is asked now (`record.request`), and of inputs
    with the same SHA-256, and where every output that it names is still there; a sidecar is written last, so outputs
    without one are unfinished. Raises RefusedError where an input is missing.
    """
    sources = sources_of(job)
    sidecar = sidecar_of(job.volume)
    try:
        record = json.loads(sidecar.read_text(encoding="utf-8"))
        same = (
            record["GeneratedBy"][0]["Version"] == __version__
            and record.keys() >= _FIGURES
            and record["Request"] == json.loads(json.dumps(request(job)))
            and all(output.is_file() for output in outputs_of(record, sidecar))
            and [(source.get("Role"), source["SHA256"]) for source in record["Sources"]]
            == [(role, sha256(path)) for path, role in sources]
        )
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        return None
    return record if same else None


def outputs_of(record: Mapping[str, Any], sidecar: Path) -> list[Path]:
    """Where the files are that a record tells of: beside its sidecar, if the study has moved since."""
    outputs = [Path(output) for output in record["Outputs"]]
    then, now = outputs[-1].parent, plain(sidecar).parent
    # By name alone, as the record's paths are: the system would go through a link first, and up from where that leads.
    return [Path(os.path.normpath(now / seen_from(then, output))) for output in outputs]
