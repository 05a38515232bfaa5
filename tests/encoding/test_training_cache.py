"""Training on cached fp32 latents equals training on frames bit for bit."""

from pathlib import Path
from typing import Any

import pytest

from latent_sets import encode_for
from run_fixtures import KilledError, dying_reporter
from same_run import assert_same_run
from vjepa2_ac.config import Config
from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.model.checkpoints import load_base
from vjepa2_ac.training.loop import train


def encode(config: Config) -> Path:
    """Encode the data set of a config and return the folder of the cache."""
    dataset = open_dataset(config.data)
    return encode_for(config, load_base(config.model, seed=config.seed), dataset)


def cache_config(folder: Path, **changes: Any) -> dict[str, Any]:
    """Return the config values that read a cache without its data set."""
    return {"data__source": "latents", "data__path": str(folder)} | changes


def test_training_on_a_lossless_cache_equals_on_the_fly_encoding_bit_for_bit(make_config, reporter, tmp_path) -> None:
    changes = {"data__camera": ("exterior_1_left", "wrist_left"), "data__start_every": 2, "training__steps": 3}
    changes |= {"data__cache_dtype": "fp32", "data__cache_dir": str(tmp_path / "caches")}
    uncached = make_config(run_dir=str(tmp_path / "fly"), **changes)
    train(uncached, reporter)
    folder = encode(uncached)
    train(make_config(run_dir=str(tmp_path / "cached"), **(changes | cache_config(folder))), reporter)
    assert_same_run(tmp_path / "fly", tmp_path / "cached")
    train(make_config(run_dir=str(tmp_path / "required"), **(changes | {"data__cache": "require"})), reporter)
    assert_same_run(tmp_path / "fly", tmp_path / "required")


def test_run_on_frames_resumes_on_a_cache(make_config, reporter, tmp_path, whole_run) -> None:
    changes = {"data__cache_dtype": "fp32", "data__cache_dir": str(tmp_path / "caches")}
    encode(make_config(**changes))
    with pytest.raises(KilledError):
        train(make_config(run_dir=str(tmp_path / "killed"), **changes), dying_reporter(type(reporter)(), 3))
    cached = make_config(run_dir=str(tmp_path / "killed"), **(changes | {"data__cache": "require"}))
    train(cached, reporter, allow_config_change=True)
    assert_same_run(whole_run, tmp_path / "killed")
