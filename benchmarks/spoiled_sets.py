"""Which faults of a data set does `data check` see, without a model and with one? Sets spoiled in each way, and asked.

    python benchmarks/spoiled_sets.py                          # a simulated arm, and the model that knows it
    python benchmarks/spoiled_sets.py --data my.yaml --model facebook_ac.pt --faults "as it is" BGR

Some episodes are read, spoiled, and written as .npz; of each such set `data check` says what it would say to anybody.
Counted is what it does not say of the same set as it is: refused (an error, or a set that cannot be opened), warned,
missed. The probe is what `data check --model` adds: named (the variant in which
the fault is mended fits better), misled (another one does), missed. Of the set as it is, any alarm is a false one.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from faults import CLEAN, FAULTS, Fault, Recording, spoiled

from vjepa2_ac.config import Config
from vjepa2_ac.config.loading import load_config, parse_config
from vjepa2_ac.data.dataset import Dataset, open_dataset
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.calibration.data import VariantProbe, probe_config
from vjepa2_ac.inspection.check import check_data
from vjepa2_ac.inspection.coverage import sample_of
from vjepa2_ac.inspection.findings import Finding
from vjepa2_ac.inspection.statistics import at_some_stride
from vjepa2_ac.simulation.record import RecordingSpec, record_dataset

HELD_OUT = 0.7  # of the episodes: the probe measures these
_SAID = 68  # letters of a finding


@dataclass(frozen=True)
class Outcome:
    """What was said of a set."""

    findings: tuple[Finding, ...]
    refusal: str | None  # that ended the check, or the probe
    probe: VariantProbe | None


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a row for each fault."""
    options = _options(arguments)
    with tempfile.TemporaryDirectory() as temporary:
        recordings, stride = _recordings(options, Path(temporary))
        steps = sum(len(one.states) for one in recordings)
        print(f"{options.data or f'the simulated arm, domain {options.domain}, seed {options.seed}'}: ", end="")
        print(f"{len(recordings)} episodes, {steps} steps; stride {stride}; probed by {options.model}\n")
        print(f"{'':24}  {'check':8}  {'probe':8}  error / persistence; what is said")
        usual: set[tuple[str, str]] = set()
        for fault in FAULTS:
            if fault.name not in {CLEAN, *options.faults}:
                continue
            outcome = _asked(fault, recordings, stride, options, Path(temporary))
            if fault.name == CLEAN:  # the first
                usual = _alarms(outcome)
            _print(fault, outcome, usual)


def _options(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--data", metavar="CONFIG", help="another data set, of poses (a simulated arm)")
    parser.add_argument("--model", default="builtin:sim-tiny", help="what model.base takes, or a run (%(default)s)")
    parser.add_argument("--faults", nargs="+", default=[one.name for one in FAULTS], metavar="FAULT", help="(all)")
    parser.add_argument("--no-probe", action="store_true", help="only `data check`, without a model")
    parser.add_argument("--episodes", type=int, default=24)
    parser.add_argument("--steps", type=int, default=61, help="of an episode, at most (61)")
    parser.add_argument("--clips", type=int, default=64, help="that are probed, at most (64)")
    parser.add_argument("--domain", default="A", help="of the simulated arm: A, B or random (A)")
    parser.add_argument("--seed", type=int, default=0, help="of the simulated arm (0)")
    return parser.parse_args(arguments)


def _recordings(options: argparse.Namespace, temporary: Path) -> tuple[list[Recording], int]:
    """Return some episodes, and the stride at which they are checked."""
    if options.data:
        config = load_config(options.data, [])
    else:
        spec = RecordingSpec(options.domain, options.steps, options.seed)
        folder = record_dataset(temporary / "simulated", spec, episodes=options.episodes)
        config = _config(folder, temporary, options.model, {"source": "rlds", "stride": 4})
    dataset = at_some_stride(open_dataset(config.data))
    if dataset.config.states != "pose" or dataset.config.source == "latents":
        raise SystemExit(f"{options.data}: a set of poses and pictures is needed")
    chosen = sample_of(dataset, options.episodes)
    return [_recording(dataset, index, options.steps) for index in chosen], dataset.config.model_stride


def _recording(dataset: Dataset, index: int, steps: int) -> Recording:
    episode = dataset.source.read(index)
    count = min(steps, len(episode.states))
    return Recording(episode.states[:count], episode.read_frames(range(count)), episode.control_rate_hz)


def _config(folder: Path, temporary: Path, model: str, data: dict[str, object]) -> Config:
    about = {
        "path": str(folder), "frames": 4, "validation_share": HELD_OUT, "test_share": 0.0, "workers": 0,
        "disk_cache": {"dir": str(temporary / "cache")},
    }  # fmt: skip
    values = {
        "run_dir": str(temporary / "run"), "data": about | data, "model": {"base": model, "dtype": "float32"},
        "training": {"precision": "fp32"},
    }  # fmt: skip
    return parse_config(values, where="spoiled_sets.py")


def _asked(
    fault: Fault, recordings: list[Recording], stride: int, options: argparse.Namespace, temporary: Path
) -> Outcome:
    findings: list[Finding] = []
    with tempfile.TemporaryDirectory(dir=temporary) as folder:
        for number, one in enumerate(spoiled(fault, recordings)):
            path = Path(folder) / f"{number:03d}.npz"
            np.savez(path, states=one.states, frames=one.frames, fps_hz=np.array(one.rate_hz))
        config = _config(Path(folder), temporary, options.model, {"source": "npz", "stride": stride})
        try:
            findings.extend(check_data(config.data))
            if options.no_probe:
                return Outcome(tuple(findings), None, None)
            probe = probe_config(config, open_dataset(config.data), model=options.model, clips=options.clips)
        except InputError as error:
            return Outcome(tuple(findings), str(error), None)
    return Outcome(tuple(findings), None, probe)


def _alarms(outcome: Outcome) -> set[tuple[str, str]]:
    """Return the errors and warnings, except those about coverage: data of low diversity have no fault."""
    alarms = [one for one in outcome.findings if one.level in {"error", "warning"}]
    return {(one.about, one.level) for one in alarms if one.about not in {"directions", "coverage"}}


def _print(fault: Fault, outcome: Outcome, usual: set[tuple[str, str]]) -> None:
    new = usual if fault.name == CLEAN else _alarms(outcome) - usual
    levels = {level for _, level in new}
    checked = "refused" if "error" in levels or outcome.refusal else "warned" if "warning" in levels else "missed"
    if fault.name == CLEAN and checked == "missed":
        checked = "quiet"
    first, *others = _said(fault, outcome, new)
    print(f"{fault.name:24}  {checked:8}  {_probed(fault, outcome.probe):8}  {first}", flush=True)
    for line in others:
        print(f"{'':46}{line}", flush=True)


def _probed(fault: Fault, probe: VariantProbe | None) -> str:
    if probe is None:
        return "-"
    if probe.better is None:
        return "quiet" if fault.name == CLEAN else "missed"
    return "named" if probe.better.name == fault.variant else "misled"


def _said(fault: Fault, outcome: Outcome, new: set[tuple[str, str]]) -> Iterator[str]:
    probe = outcome.probe
    if probe is None:
        yield (outcome.refusal or "")[:_SAID]
    else:
        better = "" if probe.better is None else f"; {probe.better.ratio.value:.3f} with {probe.better.name}"
        yield f"{probe.plain.ratio}{better}"
    for one in outcome.findings:
        is_answer = one.about == "agreement" and fault.name == CLEAN
        if (one.about, one.level) in new or is_answer:
            text = one.text if len(one.text) <= _SAID else one.text[:_SAID].rsplit(" ", 1)[0] + " …"
            yield f"{one.level} {one.about}: {text}"


if __name__ == "__main__":
    main()
