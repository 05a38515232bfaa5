"""Another form of data is one module and one section: config, errors, clips and training know it at once."""

from collections.abc import Iterator
from itertools import islice

import pytest

from vjepa2_ac.config import Config, DataConfig
from vjepa2_ac.config.loading import config_as_yaml, load_config, parse_config
from vjepa2_ac.config.run import ReplayConfig
from vjepa2_ac.config.section import Affects, mark_of, marks_of
from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.data.loader import training_loader
from vjepa2_ac.errors import InputError
from vjepa2_ac.training.loop import train


@pytest.fixture
def _toy() -> Iterator[None]:
    import toy_source

    DataConfig.kinds["toy"] = toy_source.ToyData
    _rebuild()
    yield
    del DataConfig.kinds["toy"]
    _rebuild()


def _rebuild() -> None:
    marks_of.cache_clear()
    for section in (DataConfig, ReplayConfig, Config):  # each holds those before it
        section.model_rebuild(force=True)


def values(**data: object) -> dict[str, object]:
    return {"run_dir": "r", "model": {"base": "b"}, "data": {"source": "toy", "path": "nowhere", "frames": 3, **data}}


@pytest.mark.usefixtures("_toy")
def test_a_toy_is_read_from_a_config_written_and_trained_on(make_config, reporter, tmp_path) -> None:
    config = parse_config(values(toy={"episodes": 40, "steps": 12}, workers=0), where="here")
    (tmp_path / "config.yaml").write_text(config_as_yaml(config))
    assert load_config(tmp_path / "config.yaml") == config
    batch = next(islice(training_loader(open_dataset(config.data), seed=0, batch_size=2), 1))
    assert batch.frames.shape == (2, 3, 24, 32, 3)
    folder = train(make_config(data__source="toy", data__toy={"episodes": 40}, training__steps=2), reporter)
    assert reporter.steps == [1, 2]
    assert load_config(folder / "config.yaml").data.own_section["toy"].episodes == 40


@pytest.mark.usefixtures("_toy")
def test_what_is_wrong_with_its_knobs_is_told_as_of_any_form() -> None:
    assert mark_of("data.toy.steps", Config) == Affects.EPISODES
    for data, complaint in (
        ({"toy": {"episode": 3}}, r"data\.toy\.episode: unknown key; did you mean episodes\?"),
        ({"toy": {"episodes": "many"}}, r"data\.toy\.episodes: Input should be a valid integer \(found 'many'\)"),
        ({"fields": {"state": ["a"]}}, r"data\.fields: a section of source rlds, and this is source toy"),
        ({"states": "vector"}, "source toy: a matter of poses"),
        ({"source": "toys"}, r"data\.source: Input should be 'rlds' or .* or 'toy' \(found 'toys'\)"),
    ):
        with pytest.raises(InputError, match=complaint):
            parse_config(values(**data), where="here")


def test_it_is_gone_afterwards() -> None:
    with pytest.raises(InputError, match=r"data\.source: Input should be 'rlds' or .* or 'latents' \(found 'toy'\)"):
        parse_config(values(), where="here")
