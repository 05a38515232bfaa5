"""Benchmarks that nobody runs every day still run, and compare only what computes the same."""

import json
import re
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import torch
from torch._dynamo.utils import counters

from paths import ROOT
from tracing import tracing

ELSEWHERE = """
from torch import nn

class Mixer(nn.Module):
    def __init__(self, width):
        super().__init__()
        self.qkv, self.proj = nn.Linear(width, 3 * width), nn.Linear(width, width)

    def forward(self, tokens):
        return self.proj(self.qkv(tokens)[..., : tokens.shape[-1]])

class Mlp(nn.Module):
    def __init__(self, width):
        super().__init__()
        self.fc1, self.fc2 = nn.Linear(width, 4 * width), nn.Linear(4 * width, width)

    def forward(self, tokens):
        return self.fc2(self.fc1(tokens))

class Block(nn.Module):
    def __init__(self, width):
        super().__init__()
        self.norm1, self.norm2 = nn.LayerNorm(width), nn.LayerNorm(width)
        self.attn, self.mlp = Mixer(width), Mlp(width)

    def forward(self, tokens):
        tokens = tokens + self.attn(self.norm1(tokens))
        return tokens + self.mlp(self.norm2(tokens))

class VisionTransformerPredictorAC(nn.Module):
    def __init__(self, embed_dim, predictor_embed_dim, depth, **_):
        super().__init__()
        self.predictor_embed = nn.Linear(embed_dim, predictor_embed_dim)
        self.action_encoder, self.state_encoder = (nn.Linear(7, predictor_embed_dim) for _ in range(2))
        self.extrinsics_encoder = nn.Linear(6, predictor_embed_dim)
        self.predictor_blocks = nn.ModuleList(Block(predictor_embed_dim) for _ in range(depth))
        self.predictor_norm = nn.LayerNorm(predictor_embed_dim)
        self.predictor_proj = nn.Linear(predictor_embed_dim, embed_dim)

    def forward(self, latents, actions, states):
        tokens = self.predictor_embed(latents)
        for block in self.predictor_blocks:
            tokens = block(tokens)
        return self.predictor_proj(self.predictor_norm(tokens))
"""


@pytest.fixture
def train_step(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The benchmark, imported as where it lies; nothing of it stays."""
    yield from imported_from_where_it_lies("train_step", monkeypatch)


@pytest.fixture
def planning(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The benchmark of decisions, as well; its name is that of a folder of tests, too."""
    monkeypatch.delitem(sys.modules, "planning", raising=False)
    yield from imported_from_where_it_lies("planning", monkeypatch)


def imported_from_where_it_lies(name: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    threads, before = torch.get_num_threads(), set(sys.modules)
    monkeypatch.setattr(sys, "path", [str(ROOT / "benchmarks"), *sys.path])
    yield import_module(name)
    torch.set_num_threads(threads)
    own = {path.stem for path in (ROOT / "benchmarks").glob("*.py")} | {"src", "notebooks"}
    for module in set(sys.modules) - before:
        if module.split(".")[0] in own:
            del sys.modules[module]


def rows(printed: str) -> list[tuple[str, float, float]]:
    """Return way, milliseconds and ratio of each line of the table."""
    found = re.findall(r"^ +\d+ +\d+ +(?:yes|no) +(\w+) +(\d+) .* (\S+)$", printed, re.MULTILINE)
    return [(way, float(ms), float(ratio)) for way, ms, ratio in found]


def test_quick_benchmark_of_a_training_step_completes_without_the_official_code(
    train_step: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    train_step.main(
        ["--quick", "--no-memory", "--encoder", "--checkpointing", "off", "on", "--official", str(tmp_path)]
    )
    printed = capsys.readouterr().out
    assert f"official: skipped, for there is no {tmp_path}" in printed
    assert [way for way, _, _ in rows(printed)] == ["dense", "auto"] * 2
    assert [ratio for _, _, ratio in rows(printed)][::2] == [1.0, 1.0]


def test_all_rows_of_a_training_step_come_from_one_command_and_what_runs_out_of_memory_says_so(
    train_step: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = sys.modules["timed_steps"].Bench
    usual = bench.step

    def step(self: Any, setting: Any, way: str) -> Any:
        if setting.encoder and way == "per_step":
            raise torch.OutOfMemoryError
        return usual(self, setting, way)

    monkeypatch.setattr(bench, "step", step)
    file = tmp_path / "results" / "steps.json"
    train_step.main([
        "--quick", "--no-memory", "--official", str(tmp_path), "--source", "cache", "pixels", "--attention", "per_step",
        "--profile", "--cap-gb", "24", "--json", str(file),
    ])  # fmt: skip
    printed = capsys.readouterr().out
    assert re.search(r"^ +4 +1 +no +per_step +out of memory \(pixels\)$", printed, re.MULTILINE)
    found = [(row["encoder"], row["way"], row["ms"] is None) for row in json.loads(file.read_text())["rows"]]
    assert found == [
        (False, "dense", False), (False, "per_step", False), (True, "dense", False), (True, "per_step", True),
    ]  # fmt: skip
    first = json.loads(file.read_text())["rows"][0]
    assert first["waits"] > 0
    assert first["first_s"] > 0
    assert first["compiled_after"] == 0


def test_the_largest_batch_is_the_last_that_fits(train_step: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    class Cuda:
        device = torch.device("cuda")

    monkeypatch.setattr(train_step, "fitting_step", lambda _, setting, __: setting.batch <= fitting)
    setting = sys.modules["timed_steps"].Setting(16, 1, checkpointing=True)
    for fitting in (1, 2, 19, 128, 500):
        assert train_step.largest_batch(Cuda(), setting, "auto") == min(fitting, 128)


def test_doctor_is_asked_about_the_setting_that_is_measured(train_step: Any, tmp_path: Path) -> None:
    timed = sys.modules["timed_steps"]
    bench = timed.Bench(train_step.parse(["--quick", "--official", str(tmp_path)]), "bfloat16")
    small, large = (bench.estimated_gb(timed.Setting(4, batch, False)) for batch in (1, 64))
    again = bench.estimated_gb(timed.Setting(4, 64, True))
    assert 0 < small < again < large


def test_peak_memory_of_one_way_is_told_as_a_number_alone(
    train_step: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    train_step.main(["--quick", "--official", str(tmp_path), "--memory-of", "auto"])
    assert 0.01 < float(capsys.readouterr().out) < 100


def test_no_ratio_is_printed_to_a_predictor_that_computes_something_else(
    train_step: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "src" / "models").mkdir(parents=True)
    (tmp_path / "src" / "models" / "ac_predictor.py").write_text(ELSEWHERE)
    train_step.main(["--quick", "--no-memory", "--official", str(tmp_path)])
    printed = capsys.readouterr().out
    assert "official: NO RATIO" in printed
    assert [way for way, _, _ in rows(printed)] == ["dense", "auto"]


@pytest.fixture
def numerics(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The comparison of what ways learn."""
    yield from imported_from_where_it_lies("numerics", monkeypatch)


def test_ways_learn_the_same_and_one_that_does_not_is_found(
    numerics: Any, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    numerics.main(["--steps", "12"])
    printed = capsys.readouterr().out
    assert re.search(r"^per_step: strays by \S+ in 3 steps", printed, re.MULTILINE)
    assert re.search(r"^bfloat16: \S+ after 16 predictions", printed, re.MULTILINE)
    from vjepa2_ac.model import attention

    wrong = {**attention._IMPLEMENTATIONS, "per_step": lambda *given: attention._dense(*given) * 1.01}
    monkeypatch.setattr(attention, "_IMPLEMENTATIONS", wrong)
    with pytest.raises(SystemExit, match="beyond its tolerance"):
        numerics.main(["--steps", "12"])


DECISION = re.compile(r"^ +(\d+) +(\S+) +(\S+) +\S+ +(\S+)% +(\S+) +(\S+) +(\S+)$", re.MULTILINE)
"""Horizon, way, seconds, MFU, peak memory, ratio to plain, ratio to official."""


def test_quick_benchmark_of_a_decision_completes_without_the_official_code(
    planning: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    planning.main(["--quick", "--no-memory", "--official", str(tmp_path), "--profile"])
    printed = capsys.readouterr().out
    assert f"official: skipped, for there is no {tmp_path}" in printed
    assert "aten::addmm" in printed
    lines = DECISION.findall(printed)
    assert [(horizon, way) for horizon, way, *_ in lines] == [("3", "plain"), ("3", "ours/4"), ("3", "ours/1")]
    for _, _, seconds, mfu, _, of_plain, of_official in lines:
        assert 0 < float(seconds) < 60
        assert 0 < float(mfu) < 150
        assert 0 < float(of_plain) < 100
        assert of_official == "nan"
    assert lines[0][5] == "1.00"


@pytest.mark.usefixtures("traced")
@tracing[0]
@tracing[1]
def test_decisions_with_compiled_blocks_are_timed_beside_those_without(
    planning: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    planning.main(["--quick", "--no-memory", "--official", str(tmp_path), "--compile"])
    ways = [way for _, way, *_ in DECISION.findall(capsys.readouterr().out)]
    assert ways == ["plain", "ours/4", "ours/4+compiled", "ours/1", "ours/1+compiled"]
    assert counters["stats"]["unique_graphs"]


def test_decisions_in_8_bits_are_timed_and_say_what_they_cost(
    planning: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("torchao", reason="the extra quantize is not installed")
    planning.main(["--quick", "--no-memory", "--official", str(tmp_path), "--quantize", "int8"])
    printed = capsys.readouterr().out
    ways = [way for _, way, *_ in DECISION.findall(printed)]
    assert ways == ["plain", "ours/4", "ours/4+int8", "ours/1", "ours/1+int8"]
    changes = re.findall(r"ours/[41]\+int8: the plan's energy changes by (\S+)%", printed)
    assert len(changes) == 2
    assert all(abs(float(change)) < 10 for change in changes)


def test_peak_memory_of_a_decision_is_told_as_a_number_alone(
    planning: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    planning.main(["--quick", "--official", str(tmp_path), "--memory-of", "ours/4", "4"])
    assert 0.01 < float(capsys.readouterr().out) < 100


@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_no_ratio_is_printed_to_a_decision_that_comes_out_otherwise(
    planning: Any, dtype: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    poses = sys.modules["timed_decisions"]._poses_one_by_one
    monkeypatch.setattr("timed_decisions._poses_one_by_one", lambda states, actions: poses(states, -3 * actions))
    planning.main(["--quick", "--no-memory", "--official", str(tmp_path), "--dtype", dtype])
    printed = capsys.readouterr().out
    assert re.search(r"plain: actions differ by .*: NO RATIO", printed)
    assert [(way, of_plain) for _, way, _, _, _, of_plain, _ in DECISION.findall(printed)] == [
        ("ours/4", "nan"), ("ours/1", "nan"),
    ]  # fmt: skip


NOTEBOOK = """
import torch

class WorldModel:
    def __init__(self, mpc_args, device, **_):
        self.asked = mpc_args

    def infer_next_action(self, rep, pose, goal_rep):
        assert rep.shape == goal_rep.shape == (1, 4, 128)
        assert pose.shape == (1, 1, 7)
        assert not torch.is_grad_enabled()
        assert torch.initial_seed() == 0
        assert sorted(self.asked) == [
            "cem_steps", "maxnorm", "momentum_mean", "momentum_mean_gripper", "momentum_std", "momentum_std_gripper",
            "rollout", "samples", "topk",
        ]
        return torch.zeros(self.asked["rollout"], 7) if torch.randn(3, device="cpu").any() else None
"""


def test_no_ratio_is_printed_to_a_notebook_that_plans_otherwise(
    planning: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "src" / "models").mkdir(parents=True)
    (tmp_path / "src" / "models" / "ac_predictor.py").write_text(ELSEWHERE)
    (tmp_path / "notebooks" / "utils").mkdir(parents=True)
    (tmp_path / "notebooks" / "utils" / "world_model_wrapper.py").write_text(NOTEBOOK)
    planning.main(["--quick", "--no-memory", "--official", str(tmp_path)])
    printed = capsys.readouterr().out
    assert re.search(r"official: actions differ by .*: NO RATIO", printed)
    assert [way for _, way, *_ in DECISION.findall(printed)] == ["plain", "ours/4", "ours/1"]


def test_a_decision_is_counted_and_timed_in_the_type_and_towards_the_goal_that_were_asked_for(
    planning: Any, tmp_path: Path
) -> None:
    decisions = sys.modules["timed_decisions"]
    options = planning.parse(["--quick", "--official", str(tmp_path)])
    bench = decisions.Bench(options, "bfloat16")
    for horizon in (1, 3):
        cost = decisions.WorldModelCost(bench.model, bench._scene, bench._goal(horizon), decisions.EnergyConfig())
        with torch.no_grad():
            assert float(cost(torch.tensor(decisions.WANTED).expand(1, horizon, -1))) < 1e-5
            assert float(cost(torch.zeros(1, horizon, 7))) > 1e-3
    assert bench.model.predictor.dtype == torch.float32  # until all were compared
    plan = bench.decision(decisions.Way.ours(2), 3)()
    assert bench.model.predictor.dtype == torch.bfloat16
    assert len(plan.actions) == 3
    assert plan.evaluations == bench.sequences
    assert bench.flops(3) == bench.sequences * decisions.plan_flops(bench.sizes, 3)


def test_ways_take_turns_and_a_ratio_is_of_neighbours(planning: Any) -> None:
    calls: list[str] = []
    ways = {"plain": lambda: calls.append("p"), "ours/1": lambda: calls.append("o")}
    times = sys.modules["timing"].take_turns(ways, planning.parse(["--repeats", "2"]))
    assert "".join(calls) == "popopo"  # the first round warms up
    assert [len(one) for one in times.values()] == [2, 2]
    seconds = {"plain": [2.0, 30.0, 8.0], "ours/1": [1.0, 10.0, 2.0]}
    assert planning.ratio(seconds, "plain", "ours/1") == 3.0


def test_on_cuda_the_papers_setting_is_measured(planning: Any) -> None:
    options = planning.parse(["--device", "cuda"])
    assert (options.samples, options.iterations, options.horizon, options.layers) == (800, 10, [1, 2], 24)
    assert (options.width, options.latent_dim, options.image_size, options.dtype) == (1024, 1408, 256, ["bfloat16"])
    assert planning.parse(["--device", "cuda", "--samples", "9"]).samples == 9


def test_quick_benchmark_of_latents_tells_speed_size_and_added_error(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("mujoco", reason="the arm is simulated")
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    import_module("latents").main(["--quick"])
    monkeypatch.delitem(sys.modules, "latents")
    printed = capsys.readouterr().out
    assert re.search(r"^ +4 +\d+\.\d+ +\d+\.\d% +\d+\.\d+ +\d+% +\d+ +\d+ +\d+\.\d\dx$", printed, re.MULTILINE)
    hours = [float(hour) for hour in re.findall(r"^ +(?:int8|bf16|fp32) +\S+ +(\d\.\d\d) +\S+$", printed, re.MULTILINE)]
    bf16, fp32, int8 = hours
    assert int8 < bf16 < fp32
    added = re.findall(r"^ +random +(\w+) +\S+ +(\S+)% +\S+ +(\S+)%", printed, re.MULTILINE)
    assert [kind for kind, *_ in added] == ["fp32", "bf16", "int8"]
    assert all(float(one) == 0 for kind, *percent in added if kind == "fp32" for one in percent)
    assert all(abs(float(one)) < 2 for _, *percent in added for one in percent)
