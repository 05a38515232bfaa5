"""The public names: known to users, editors and docs alike, imported when they are used, and good for what they say."""

import inspect
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import vjepa2_ac
from adapted_run import write_adapted_run
from paths import ROOT
from run_fixtures import MakeConfig
from vjepa2_ac import (
    UserError,
    WorldModel,
    encode,
    evaluate,
    load_config,
    load_model,
    load_run,
    open_dataset,
    read_clips,
    train,
)
from vjepa2_ac.distributed import has_bf16
from vjepa2_ac.export import export_run

PAGE = (ROOT / "docs/python.md").read_text()
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)
TINY = "builtin:sim-tiny"


# The names.


def test_api_page_lists_exactly_the_public_names() -> None:
    table = PAGE.split("| name | description |")[1].split("\n\n")[0]
    documented = re.findall(r"^\| `(\w+)", table, flags=re.MULTILINE)
    assert sorted(documented) == sorted(vjepa2_ac.__all__)


@pytest.mark.parametrize("name", [name for name in vjepa2_ac.__all__ if name[0].islower()])
def test_api_page_shows_the_parameters_of_each_function(name: str) -> None:
    (shown,) = re.findall(rf"^\| `{name}\((.*?)\)`", PAGE, flags=re.MULTILINE)
    parameters = inspect.signature(getattr(vjepa2_ac, name)).parameters.values()
    assert re.findall(r"\w+", shown) == [parameter.name for parameter in parameters]
    assert len(parameters) <= 6


def test_package_import_is_light_and_dir_lists_public_names() -> None:
    code = (
        "import os, sys\n"
        "before = dict(os.environ)\n"
        "import vjepa2_ac\n"
        "assert os.environ == before\n"
        "assert set(vjepa2_ac.__all__) <= set(dir(vjepa2_ac))\n"
        "found = {name for name in sys.modules if name.startswith('vjepa2_ac.')}\n"
        "assert not found and not {'torch', 'numpy', 'pydantic'} & set(sys.modules), found\n"
        "from vjepa2_ac.cli import main\n"
        "try: main(['--help'])\n"
        "except SystemExit: pass\n"
        "assert not {'torch', 'transformers', 'numpy', 'mujoco'} & set(sys.modules)\n"
        "from vjepa2_ac import UserError, load_config\n"
        "assert not {'torch', 'transformers'} & set(sys.modules)\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL)


def test_unknown_public_name_lists_known_names() -> None:
    with pytest.raises(AttributeError, match=r"no 'load_modle'; its public names are Controller, .* load_model"):
        vjepa2_ac.load_modle  # type: ignore[attr-defined]  # noqa: B018


@pytest.mark.usefixtures("clone")
def test_docs_code_runs(capsys: pytest.CaptureFixture[str]) -> None:
    names: dict[str, Any] = {}
    for block in BLOCKS:
        quick = block.replace('"steps": 20', '"steps": 2, "allow_weak_base": True').replace("samples=50", "samples=12")
        exec(quick, names)  # noqa: S102 - our own page, as a reader runs it
    printed = capsys.readouterr().out
    assert "8 episodes, " in printed
    assert "Validation at step 2" in printed
    assert "did you mean frames?" in printed
    assert isinstance(names["model"], WorldModel)
    (in_readme,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), flags=re.DOTALL)
    exec(in_readme.replace("demo/run", "demo/examples/short").replace("demo/data", "demo/examples/data"), names)  # noqa: S102


# Models.


def test_loaded_model_is_in_eval_mode_and_predicts() -> None:
    model = load_model(TINY)
    assert (model.image_size, model.num_tokens, model.latent_dim) == (96, 36, 128)
    assert not model.training
    assert not any(value.requires_grad for value in model.parameters())
    assert next(load_model(TINY, device="cpu", dtype="bfloat16").parameters()).dtype == torch.bfloat16


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"name": "nowhere"}, "vjepa2-ac download"),
        ({"name": ""}, "is empty"),
        ({"name": "gs://bucket/model"}, "URL"),
        ({"name": TINY, "dtype": "float64"}, "dtype: .*float32"),
        ({"name": TINY, "device": "gpu"}, "auto, cpu, cuda"),
        ({"name": TINY, "adapter": "nowhere"}, "nowhere"),
    ],
    ids=lambda value: "-".join(value.values()) if isinstance(value, dict) else "",
)
def test_unloadable_model_raises(arguments: dict[str, Any], words: str) -> None:
    with pytest.raises(UserError, match=words):
        load_model(**arguments)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is CUDA")
def test_unavailable_cuda_raises() -> None:
    with pytest.raises(UserError, match="finds no CUDA device"):
        load_model(TINY, device="cuda:0")


def test_device_capability_uses_the_device_index(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda index: f"card {index}")
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda index: [(8, 0), (7, 5)][index])
    with pytest.raises(UserError, match=r"device: cuda:9.* cuda:0 to cuda:1"):
        load_model(TINY, device="cuda:9")
    monkeypatch.setenv("LOCAL_RANK", "1")
    assert [has_bf16(torch.device(name)) for name in ("cuda:0", "cuda:1", "cuda")] == [True, False, False]
    monkeypatch.setenv("LOCAL_RANK", "0")
    with pytest.raises(UserError, match=r"card 1 of compute capability 7\.5"):
        load_model(TINY, device="cuda:1", dtype="bfloat16")
    monkeypatch.setattr(WorldModel, "to", lambda model, _: model)
    assert next(load_model(TINY, device="cuda:1").parameters()).dtype == torch.float32


@torch.no_grad()
def test_run_and_exported_adapter_give_equal_predictions(make_config: MakeConfig, tmp_path: Path) -> None:
    folder = write_adapted_run(make_config(run_dir=str(tmp_path / "run")))
    run = load_run(folder)
    assert run.checkpoint.name != load_run(folder, "newest").checkpoint.name
    assert load_run(folder, 10).checkpoint == run.checkpoint
    hub = export_run(folder, tmp_path / "hub", "hub", "best").path
    exported = load_model(str(run.config.model.base), adapter=hub, dtype="float32")
    inputs = torch.randn(1, 2, exported.num_tokens, exported.latent_dim), torch.ones(1, 2, 7), torch.ones(1, 2, 7)
    torch.testing.assert_close(exported.predict(*inputs), run.world_model.predict(*inputs), rtol=0, atol=0)
    with pytest.raises(UserError, match=r"load_model\(BASE, adapter=FOLDER\)"):
        load_run(hub)
    with pytest.raises(UserError, match="no such folder"):
        load_run(tmp_path / "nowhere")


# Data.


def test_open_dataset_applies_config_and_keyword_arguments(simulated: Path) -> None:
    values = {"run_dir": "none", "data": {"path": simulated, "frames": 3}, "model": {"base": TINY}}
    config = load_config(values, ["data.stride=auto"])
    with pytest.raises(UserError, match="stride=4"):
        read_clips(open_dataset(config))
    dataset = open_dataset(config, stride=2)
    assert (dataset.config.frames, dataset.config.stride) == (3, 2)
    with pytest.raises(UserError, match="train, validation, test"):
        read_clips(dataset, "tset")  # type: ignore[arg-type]


# Latents.


def test_frames_and_batches_have_the_same_latents(simulated: Path) -> None:
    model = load_model(TINY)
    batch = next(read_clips(open_dataset(simulated, frames=2), clips=2))
    encoded = encode(model, batch)
    assert batch.frames is not None
    frame_latents = encode(model, batch.frames.numpy())
    assert tuple(frame_latents.shape) == (2, 2, 36, 128)
    torch.testing.assert_close(frame_latents, encoded.latents)
    image = encode(model, batch.frames.numpy()[1, 0])
    assert tuple(image.shape) == (36, 128)
    torch.testing.assert_close(image, encoded.latents[1, 0], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("frames", [np.zeros((4, 4, 3)), np.zeros((4, 4), np.uint8), np.zeros((3, 4, 4), np.uint8)])
def test_invalid_frames_raise(frames: np.ndarray) -> None:
    with pytest.raises(UserError, match="uint8"):
        encode(load_model(TINY), frames)


# Runs.


def test_run_is_trained_resumed_and_evaluated(make_config: MakeConfig, tmp_path: Path) -> None:
    notes: list[str] = []
    steps: dict[int, float] = {}
    config = make_config(training__steps=2, validation__every=2, data__test_share=0.4)
    train(config, check_only=True)
    assert not Path(config.run_dir).exists()
    run = train(config, note=notes.append, on_step=lambda step, metrics: steps.update({step: metrics["loss"]}))
    assert run == Path(config.run_dir)
    assert sorted(steps) == [1, 2]
    assert sum(note.startswith("Validation at step") for note in notes) == 2
    assert train(config, on_step=lambda *_: pytest.fail("it is finished")) == run
    result = evaluate(run, clips=4, checkpoint="newest", out=tmp_path / "out", probes=False)
    assert list(result.error_over_persistence) == ["base", "adapter"]
    assert len(result.error_over_persistence["adapter"]) == config.data.frames - 1
    assert " ".join(str(result.summary).split()).startswith(result.evaluation.title)
    assert all(path.parent == tmp_path / "out" for path in result.files)
    with pytest.raises(UserError, match="no checkpoint of step 7"):
        evaluate(run, checkpoint=7)
    with pytest.raises(UserError, match="no such folder"):
        evaluate(tmp_path / "nowhere")
    with pytest.raises(UserError, match="out=FOLDER"):
        evaluate(TINY, data=config)
