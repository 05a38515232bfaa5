"""Files that other users write or read: modes follow the umask, and errors name refused, special or invalid files."""

import os
import re
import shutil
import stat
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from accidents import without_permission
from random_decoder import write_decoder
from run_fixtures import TINY, TINY_CONFIG, MakeConfig
from vjepa2_ac.config import AdapterConfig, DiskCacheConfig, EncoderConfig, ModelConfig, ModelSizes, SizesConfig
from vjepa2_ac.data.index import EpisodeTable, get_or_build_index
from vjepa2_ac.data.sources.latent_files import LatentFiles
from vjepa2_ac.data.sources.latents import EPISODES_FILE, read_table
from vjepa2_ac.decoding.decoder import load_decoder
from vjepa2_ac.episode import EpisodeInfo
from vjepa2_ac.errors import InputError, RefusedError, describe_error
from vjepa2_ac.export import export_run
from vjepa2_ac.model.adapter_folder import load_trained, save_trained
from vjepa2_ac.model.checkpoints import load_base, load_official, to_official
from vjepa2_ac.model.lora import add_adapter
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.policies.action_prior import ActionPrior, PriorCard, PriorSizes, load_prior, save_prior
from vjepa2_ac.reporter import SILENT
from vjepa2_ac.reports.metrics_json import read_metrics
from vjepa2_ac.training.loop import train

SIZES = ModelSizes.model_validate(TINY)
TABLE = EpisodeTable.from_infos([EpisodeInfo("one", 10)])


def model() -> WorldModel:
    return WorldModel.random(SIZES, seed=0)


def write_adapter(folder: Path, kind: str = "lora") -> None:
    adapted = model()
    add_adapter(adapted, AdapterConfig(kind=kind, rank=2, alpha=2.0), seed=0)
    save_trained(adapted, folder)


def write_prior(folder: Path) -> None:
    sizes = PriorSizes(grid=2, dim=24, state=7, action=7, ahead=3)
    card = PriorCard("vjepa2-ac prior 1", sizes, "an encoder", "released", "nowhere", 0)
    save_prior(folder, card, ActionPrior(sizes))


def write_all(root: Path) -> None:
    """Write a file of weights, and of caches, in each form."""
    model().save_pretrained(root / "model")
    torch.save(to_official(model()), root / "official.pt")
    write_adapter(root / "adapter")
    write_adapter(root / "predictor", "none")
    write_decoder(root / "decoder", model())
    write_prior(root / "prior")
    get_or_build_index(DiskCacheConfig(dir=str(root)), "key", "/data", lambda: TABLE)
    (root / "latents").mkdir()
    (root / "latents" / EPISODES_FILE).write_bytes(TABLE.to_bytes())
    (root / "metrics.json").write_text("{}")


READERS: dict[str, Callable[[Path], object]] = {
    "model/encoder.safetensors": lambda root: WorldModel.from_pretrained(root / "model"),
    "model/predictor/model.safetensors": lambda root: WorldModel.from_pretrained(root / "model"),
    "model/config.json": lambda root: WorldModel.from_pretrained(root / "model"),
    "adapter/adapter_model.safetensors": lambda root: load_trained(model(), root / "adapter"),
    "predictor/predictor.safetensors": lambda root: load_trained(model(), root / "predictor"),
    "decoder/decoder.safetensors": lambda root: load_decoder(root / "decoder"),
    "prior/prior.safetensors": lambda root: load_prior(root / "prior", where="planning.prior"),
    "official.pt": lambda root: load_official(root / "official.pt", SIZES),
    "index/key.index": lambda root: get_or_build_index(
        DiskCacheConfig(dir=str(root)), "key", "/data", lambda: pytest.fail("built again")
    ),
    f"latents/{EPISODES_FILE}": lambda root: read_table(str(root / "latents" / EPISODES_FILE), EpisodeTable),
    "metrics.json": read_metrics,
}
CACHED = "index/key.index"  # a damaged index is built again instead of raising


@pytest.fixture(scope="module")
def original_files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("written")
    write_all(root)
    return root


@pytest.fixture
def files(original_files: Path, tmp_path: Path) -> Path:
    return shutil.copytree(original_files, tmp_path / "files")


@pytest.mark.parametrize("name", READERS)
def test_permission_error_names_mode_and_owner(files: Path, name: str) -> None:
    before = (files / name).read_bytes()
    with without_permission(files / name), pytest.raises(RefusedError) as caught:
        READERS[name](files)
    refused = r"Permission denied \(mode 0000, owner uid \d+; this process runs as uid \d+\)\. .*chmod; or run this"
    assert re.search(rf"{re.escape(name)}: cannot be read: {refused}", str(caught.value)), caught.value
    assert (files / name).read_bytes() == before


@pytest.mark.parametrize("name", sorted(READERS.keys() - {CACHED}))
@pytest.mark.parametrize("kind", ["pipe", "device", "folder"])
def test_pipe_device_or_folder_in_place_of_a_file_raises_at_once(files: Path, name: str, kind: str) -> None:
    (files / name).unlink()
    if kind == "pipe":
        os.mkfifo(files / name)
    elif kind == "device":
        (files / name).symlink_to("/dev/zero")
    else:
        (files / name).mkdir()
    description = "Is a directory" if kind == "folder" else "a pipe or a device"
    with pytest.raises(InputError, match=f"{re.escape(name)}: .*{description}"):
        READERS[name](files)


@pytest.mark.parametrize("name", sorted(reader for reader in READERS if reader.endswith(".safetensors")))
@pytest.mark.parametrize("dtype", [torch.float8_e4m3fn, torch.int64, torch.bool, torch.complex64])
def test_weights_of_unsupported_type_raise(files: Path, name: str, dtype: torch.dtype) -> None:
    weights = load_file(files / name)
    tensor = sorted(weights)[0]
    save_file({**weights, tensor: weights[tensor].to(dtype)}, files / name, metadata={"format": "pt"})
    with pytest.raises(
        InputError, match=rf"{re.escape(tensor)} has type {dtype} and .*Expected dense weights in float16"
    ):
        READERS[name](files)


@pytest.mark.parametrize("dtype", [torch.int32, torch.complex64, "sparse"])
@pytest.mark.parametrize("part", ["target_encoder", "predictor"])  # an encoder that is not loaded is not read
def test_checkpoint_weights_of_unsupported_type_raise(tmp_path: Path, part: str, dtype: object) -> None:
    parts = to_official(model())
    name = next(name for name, value in parts[part].items() if value.dim() == 2)
    value = parts[part][name]
    parts[part][name] = value.to_sparse() if dtype == "sparse" else value.to(dtype)
    torch.save(parts, tmp_path / "odd.pt")
    description = rf"odd\.pt: {part}: {re.escape(name.removeprefix('module.'))} has type torch\."
    with pytest.raises(InputError, match=rf"{description}.*Expected dense weights"):
        load_official(tmp_path / "odd.pt", SIZES)


def test_integer_encoder_weights_raise(files: Path) -> None:
    path = files / "model/encoder.safetensors"
    weights = load_file(path)
    name = sorted(weights)[0]
    save_file({**weights, name: weights[name].long()}, path)
    sizes, encoder = SizesConfig.model_validate(TINY_CONFIG), EncoderConfig(path=str(files / "model"))
    config = ModelConfig(base="random", sizes=sizes, encoder=encoder, dtype="float32")
    with pytest.raises(InputError, match=rf"{re.escape(name)} has type torch\.int64"):
        load_base(config, seed=0)


def test_latents_without_permission_are_not_encoded_again(tmp_path: Path) -> None:
    files = LatentFiles(tmp_path, "key")
    path = Path(files.path(0, "left"))
    path.parent.mkdir(parents=True)
    save_file({"latents": torch.zeros(1)}, path)
    with without_permission(path), pytest.raises(RefusedError, match="Permission denied"):
        files.is_done(0, "left")
    with without_permission(path.parent), pytest.raises(PermissionError):
        files.is_done(0, "left")
    assert not files.is_done(1, "left")


def test_permission_error_at_the_command_line_names_mode_and_owner(tmp_path: Path) -> None:
    (tmp_path / "closed").mkdir()
    with without_permission(tmp_path / "closed"), pytest.raises(PermissionError) as caught:
        list((tmp_path / "closed").iterdir())
    with without_permission(tmp_path / "closed"):
        assert re.search(r"/closed: Permission denied \(mode 0000, owner uid \d+; this", describe_error(caught.value))


def test_finished_run_with_unreadable_checkpoints_is_not_restarted(
    whole_run: Path, make_config: MakeConfig, tmp_path: Path
) -> None:
    run = shutil.copytree(whole_run, tmp_path / "run")
    weights = sorted(run.glob("checkpoints/*/adapter/adapter_model.safetensors"))
    before = {path: path.read_bytes() for path in sorted(run.rglob("*")) if path.is_file()}
    with without_permission(*weights), pytest.raises(RefusedError) as caught:
        train(make_config(), SILENT)
    assert caught.value.where == str(weights[-1])
    assert {path: path.read_bytes() for path in sorted(run.rglob("*")) if path.is_file()} == before


# ---- modes ----


@pytest.fixture(params=[0o022, 0o077], ids=["022", "077"])
def umask(request: pytest.FixtureRequest) -> Iterator[int]:
    before = os.umask(request.param)
    yield request.param
    os.umask(before)


def other_modes(root: Path, umask: int) -> dict[str, str]:
    """Return the files whose mode differs from that of a new file under a umask."""
    modes = {path: stat.S_IMODE(path.stat().st_mode) for path in root.rglob("*") if path.is_file()}
    assert modes
    return {str(path.relative_to(root)): oct(mode) for path, mode in modes.items() if mode != 0o666 & ~umask}


def test_file_modes_of_run_exports_and_latents_follow_the_umask(
    tmp_path: Path, make_config: MakeConfig, umask: int
) -> None:
    config = make_config(
        training__steps=1,
        validation__every=100,
        tracking__tensorboard=True,
        data__cache="auto",
        data__disk_cache={"dir": str(tmp_path / "cache")},
    )
    run = train(config, SILENT)
    for form in ("merged", "official", "hub"):
        export_run(run, tmp_path / form, form)
    assert {"cache", "run", "merged", "official", "hub"} <= {path.name for path in tmp_path.iterdir()}
    assert not other_modes(tmp_path, umask)
