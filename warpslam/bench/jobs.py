"""From a suite to the jobs of a batch. Runs that several studies need are made once."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from warpslam.batch.jobs import Job
from warpslam.bench.studies import Study, Variant
from warpslam.bench.suite import Rendering, SequenceSpec, StudySpec, Suite
from warpslam.camera import Intrinsics
from warpslam.config import Config
from warpslam.runs.folder import as_file_name
from warpslam.runs.request import ALL_FRAMES, RunRequest, Source, parse_slice
from warpslam.storage.json_files import read_json, write_json

RENDERED = "rendered"
"""Folder in the bench's own that holds sequences it rendered."""
_MARK = "rendering.json"


@dataclass(frozen=True)
class Entry:
    """What a study asks of one run; all but the last say where its figures go."""

    study: Study
    sequence: str
    variant: Variant
    seed: int

    job: Job
    """The run, which other entries may share."""


def expand(suite: Suite, output: Path, studies: Iterable[str] | None = None) -> list[Entry]:
    """All runs of a suite, study by study.

    Args:
        suite: The suite.
        output: Folder of the bench.
        studies: Names of those that are wanted; all by default.

    Raises:
        ConfigError: A study is not part of the suite.
    """
    entries = [
        Entry(study, name, variant, seed, _job(suite, output, study, spec, name, sequence, variant, seed))
        for study, spec in suite.studies(studies)
        for name, sequence in suite.sequences_of(spec).items()
        for variant in study.variants
        if spec.variants is None or variant.name in spec.variants
        for seed in spec.seeds or suite.spec.seeds
    ]
    # The true surface changes nothing in a run but which figures it has: a run with it serves those without.
    with_truth = {e.job.asking(truth_mesh=None): e.job for e in entries if e.job.request.truth_mesh is not None}
    return [replace(entry, job=with_truth.get(entry.job, entry.job)) for entry in entries]


def unique_jobs(entries: Iterable[Entry]) -> list[Job]:
    """Each run once, in the order in which they are first asked for."""
    return list(dict.fromkeys(entry.job for entry in entries))


def _job(
    suite: Suite,
    output: Path,
    study: Study,
    spec: StudySpec,
    name: str,
    sequence: SequenceSpec,
    variant: Variant,
    seed: int,
) -> Job:
    overrides = [*suite.spec.set, *sequence.set, *spec.set]
    truth_mesh = suite.resolve(sequence.truth_mesh)
    if sequence.render is not None:
        folder = rendered_folder(output, name, sequence.render)
        path, truth_mesh = str(folder), truth_mesh or str(folder / "mesh.ply")
    else:
        path = str(suite.resolve(sequence.path))
    poses = suite.resolve(sequence.poses) if study.given_poses else None
    if study.given_poses and poses is None:
        overrides.append("tracking.use_given_poses=true")
    if study.by_rendering and variant.method == "nice-slam":
        overrides += _by_rendering(sequence.preset or "default", overrides)
    frames = spec.frames or sequence.frames
    request = RunRequest(
        source=Source(path, sequence.dataset, sequence.camera),
        frames=parse_slice(frames) if frames is not None else ALL_FRAMES,
        preset=sequence.preset,
        overrides=_last_values([*overrides, *variant.overrides]),
        decoders=suite.resolve(sequence.decoders),
        device=suite.spec.device,
        seed=seed,
        method=variant.method,
        poses=poses,
        truth_mesh=truth_mesh if study.needs_truth_mesh else None,
    )
    return Job(as_file_name(f"{name}-{variant.method}-{_digest(request)}-seed{seed}"), request)


def _by_rendering(preset: str, overrides: list[str]) -> list[str]:
    """What has a camera tracked against renders of the map."""
    is_direct = Config.from_preset(preset, overrides).tracking.optimizer == "direct"
    return ["tracking.optimizer=gauss_newton"] if is_direct else []


def _last_values(overrides: list[str]) -> tuple[str, ...]:
    """Only the last value of each setting, so that the same settings are the same run whatever they were before."""
    last = {text.partition("=")[0]: text for text in overrides}
    return tuple(last[key] for key in sorted(last))


def _digest(request: RunRequest) -> str:
    """Of the settings; not of folders, so that names stay when data moves, nor of the seed, which is in the name."""
    is_given = [request.poses is not None, request.decoders is not None]
    fields = [request.preset, request.frames, request.overrides, *is_given]
    return hashlib.sha256(json.dumps(fields).encode()).hexdigest()[:8]


def rendered_folder(output: Path, name: str, rendering: Rendering) -> Path:
    """Where the bench keeps a sequence it rendered."""
    return (output / RENDERED / f"{as_file_name(name)}-{rendering.digest}").resolve()


def render_missing(suite: Suite, output: Path, entries: Iterable[Entry]) -> list[Path]:
    """Render the synthetic sequences that are needed and not there yet; returns their folders."""
    # The renderer loads Warp, which a bench of recordings does not need in this process.
    from warpslam.synthetic import make_sequence, write_sequence

    made = []
    for name in dict.fromkeys(entry.sequence for entry in entries):
        rendering = suite.spec.sequences[name].render
        if rendering is None:
            continue
        folder = rendered_folder(output, name, rendering)
        if (folder / _MARK).is_file() and read_json(folder / _MARK) == json.loads(rendering.model_dump_json()):
            continue
        if folder.exists():  # what an interrupted rendering left
            shutil.rmtree(folder)
        width, height = rendering.size
        focal = 250.0 * width / 320.0
        camera = Intrinsics(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)
        sequence = make_sequence(
            rendering.kind, rendering.seed, rendering.frames, intrinsics=camera, gap=rendering.gap,
            device=suite.spec.device,
        )  # fmt: skip
        write_sequence(sequence, folder)
        write_json(folder / _MARK, json.loads(rendering.model_dump_json()))
        made.append(folder)
    return made
