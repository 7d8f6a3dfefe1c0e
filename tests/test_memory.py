"""What a run is estimated to need against what it took, and what is left of the limits that a process lives under."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
import pytest
from command import ball, done, nifti, noisy, record

from beltrami_cli.config import Job, Settings
from beltrami_cli.errors import DataError, RefusedError
from beltrami_cli.memory import available, needed, told
from beltrami_cli.survey import survey

GIB = 2**30


def job(folder: Path, shape: tuple[int, ...] = (40, 40, 40), channels: int = 0, **settings: object) -> Job:
    psi = nifti(folder / "psi.nii.gz", ball(shape, radius=shape[0] / 3))
    data = nifti(folder / "data.nii.gz", noisy((*shape, channels) if channels else shape))
    kind = {"kind": "vector"} if channels else {}
    return Job(data, folder / "out.nii.gz", psi, settings=Settings(**kind, **settings))


def test_needed_grows_with_voxels(tmp_path):
    sizes = [needed(job(tmp_path, (n, n, n))) for n in (20, 40, 80)]
    assert sizes == sorted(sizes)
    assert sizes[2] - sizes[1] > 4 * (sizes[1] - sizes[0])


def test_needed_grows_with_channels_of_a_vector_and_little_with_frames(tmp_path):
    of = {count: needed(job(tmp_path, channels=count)) for count in (1, 3, 20)}
    # Each channel has at the least its data, 5 states and fluxes of the flow, and the result.
    assert of[20] - of[3] > 17 * 4 * 40**3
    assert of[3] > of[1]
    frames = [needed(job(tmp_path, channels=count, independent=True)) for count in (1, 20)]
    assert frames[1] - frames[0] < (of[20] - of[1]) / 10


def test_frames_that_are_gathered_before_they_are_written_count(tmp_path):
    streamed = job(tmp_path, channels=20, independent=True)
    gathered = Job(streamed.data, tmp_path / "out.mgz", streamed.levelset, settings=streamed.settings)
    assert needed(gathered) - needed(streamed) > 20 * 4 * 40**3


def test_needed_grows_with_precision_width_weights_and_the_library_for_metaimage(tmp_path):
    plain = needed(job(tmp_path))
    assert needed(job(tmp_path, precision="float64")) > plain
    assert needed(job(tmp_path, band=8.0)) > plain
    given = job(tmp_path)
    weighed = Job(given.data, given.volume, given.levelset, weights=given.data, mask=given.data)
    assert needed(weighed) == plain + 2 * 4 * 40**3
    assert needed(Job(given.data, tmp_path / "out.mha", given.levelset)) - plain > 100e6


def test_a_picture_needs_its_libraries_and_grows_no_more_than_the_surface(tmp_path):
    def more(size: int) -> int:
        plain = job(tmp_path, (size, size, size))
        return needed(replace(plain, report=tmp_path / "r.png")) - needed(plain)

    assert 100e6 < more(20) < 140e6
    assert more(20) < more(80) < 200e6


def test_needed_follows_the_surface_not_the_volume(tmp_path):
    inner = ball((40, 40, 40), radius=13)
    padded = np.pad(inner, 40, mode="edge")
    small, large = (
        needed(Job(nifti(tmp_path / "d.nii", noisy(psi.shape)), tmp_path / "o.nii", nifti(tmp_path / "p.nii", psi)))
        for psi in (inner, padded)
    )
    assert 4 * 3 * (padded.size - inner.size) < large - small < 4 * 6 * (padded.size - inner.size)


def test_needed_of_a_surface_and_of_values_at_its_vertices_and_of_a_flat_run(tmp_path):
    given = job(tmp_path)
    done("mesh", given.levelset, given.data, "-o", tmp_path / "ball.surf.gii", "-q")
    mesh = tmp_path / "ball.surf.gii"
    by_mesh = needed(Job(given.data, given.volume, mesh))
    assert by_mesh == pytest.approx(needed(given), rel=0.05)
    assert needed(Job(tmp_path / "ball.func.gii", tmp_path / "o.func.gii", mesh)) > 200e6
    flat = Job(given.data, given.volume, settings=Settings(flat=True))
    assert needed(flat) - 200e6 == pytest.approx(150 * 40**3, rel=0.2)


def test_needed_of_segmentations(tmp_path):
    labels = 1 + (ball((40, 40, 40), radius=10) > 0) + (ball((40, 40, 40), radius=14) > 0)
    given = job(tmp_path)
    path = nifti(tmp_path / "labels.nii.gz", labels.astype(np.uint8))
    within = needed(Job(given.data, given.volume, path, labels="1"))
    between = needed(Job(given.data, given.volume, path, between="1,3"))
    assert within < between < 1.2 * within
    mask = nifti(tmp_path / "mask.nii.gz", (labels == 1).astype(np.uint8))
    assert needed(Job(given.data, given.volume, mask)) == within


def test_a_scene_that_is_known_already_is_not_surveyed_again(tmp_path, monkeypatch):
    given = job(tmp_path)
    scene, size = survey(given), needed(given)
    monkeypatch.setattr("beltrami_cli.memory.survey", None)
    assert needed(given, scene) == size


def test_what_is_wrong_with_a_job_is_told_as_a_run_tells_it(tmp_path):
    given = job(tmp_path)
    with pytest.raises(RefusedError, match="no such file"):
        needed(Job(tmp_path / "none.nii.gz", given.volume, given.levelset))
    with pytest.raises(RefusedError, match="grids differ"):
        needed(Job(nifti(tmp_path / "other.nii.gz", noisy((20, 20, 20))), given.volume, given.levelset))
    with pytest.raises(DataError, match="no zero level"):
        needed(Job(given.data, given.volume, nifti(tmp_path / "none.nii.gz", noisy((40, 40, 40), mean=900))))


def test_estimate_of_a_real_run(tmp_path):
    given = job(tmp_path, (56, 56, 56))
    command = ["denoise", given.levelset, given.data, "-o", given.volume, "--beta", "0.05", "--iterations", "2", "-q"]
    done(*command)  # compiles what has not been compiled yet, which takes memory of its own
    subprocess.run([sys.executable, "-m", "beltrami_cli", *map(str, command), "--overwrite"], check=True)
    peak = record(tmp_path / "out.json")["PeakMemoryMiB"] * 2**20
    assert 0.9 < needed(given) / peak < 1.7


def group(root: Path, path: str, limit: str, used: int, droppable: int = 0, version: int = 2) -> None:
    names = {2: ("memory.max", "memory.current", "inactive_file")}
    names[1] = ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
    most, usage, inactive = names[version]
    folder = root / "sys/fs/cgroup" / path
    folder.mkdir(parents=True, exist_ok=True)
    (folder / most).write_text(f"{limit}\n")
    (folder / usage).write_text(f"{used}\n")
    (folder / "memory.stat").write_text(f"anon 5\n{inactive} {droppable}\nactive_file 7\n")


def member(root: Path, *lines: str) -> None:
    (root / "proc/self").mkdir(parents=True)
    (root / "proc/self/cgroup").write_text("".join(f"{line}\n" for line in lines))


def test_available_without_groups_is_what_the_system_has(tmp_path, monkeypatch):
    monkeypatch.setattr("beltrami_cli.memory._left_of_address_space", list)
    assert available(tmp_path) == pytest.approx(psutil.virtual_memory().available, rel=0.1)


def test_available_is_what_the_tightest_of_nested_groups_leaves(tmp_path):
    member(tmp_path, "0::/slurm/job_7/step_0")
    group(tmp_path, "slurm/job_7/step_0", "max", 10_000)
    group(tmp_path, "slurm/job_7", "50000000", 30_000_000, droppable=4_000_000)
    group(tmp_path, "slurm", str(900 * GIB), 40_000_000)
    assert available(tmp_path) == 24_000_000
    group(tmp_path, "slurm/job_7/step_0", "1000000", 400_000)
    assert available(tmp_path) == 600_000


def test_available_in_groups_of_the_first_version(tmp_path):
    member(tmp_path, "5:cpu,cpuacct:/job", "4:memory:/job", "0::/")
    group(tmp_path, "memory", "9223372036854771712", 70_000_000, version=1)
    group(tmp_path, "memory/job", "8000000", 6_000_000, droppable=500_000, version=1)
    assert available(tmp_path) == 2_500_000


def test_available_in_a_container_that_sees_its_own_group_as_the_top(tmp_path):
    member(tmp_path, "0::/docker/0123abcd")
    group(tmp_path, "", "3000000", 1_000_000)
    assert available(tmp_path) == 2_000_000


def test_available_is_never_below_nothing(tmp_path):
    member(tmp_path, "0::/")
    group(tmp_path, "", "1000", 2000)
    assert available(tmp_path) == 0


def test_available_here_is_something():
    assert 0 < available() <= psutil.virtual_memory().total


@pytest.mark.skipif(sys.platform == "win32", reason="has no such limit")
def test_available_under_a_limit_on_the_address_space():
    code = (
        "import resource, psutil; from beltrami_cli.memory import available;"
        "used = psutil.Process().memory_info().vms; limit = used + 300_000_000;"
        "resource.setrlimit(resource.RLIMIT_AS, (limit, limit)); print(available())"
    )
    left = int(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout)
    assert 200_000_000 < left <= 300_000_000


@pytest.mark.parametrize(
    ("size", "text"),
    [
        (0, "0 B"),
        (999, "999 B"),
        (1000, "1.0 kB"),
        (9_949, "9.9 kB"),
        (9_950, "10 kB"),
        (999_499, "999 kB"),
        (999_500, "1.0 MB"),
        (34_200_000, "34 MB"),
        (1_234_567_890, "1.2 GB"),
        (25_276_000_000, "25 GB"),
        (3 * 10**12, "3.0 TB"),
        (3 * 10**15, "3000 TB"),
    ],
)
def test_told(size, text):
    assert told(size) == text
