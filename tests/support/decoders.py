"""Decoders that are trained within a second, on the frames of the tiny run."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from run_fixtures import MakeConfig, one_thread, tiny_config
from vjepa2_ac.config import Config
from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.data.sources.latent_files import LatentFiles
from vjepa2_ac.decoding.frame_pairs import FramePairs, select_frames
from vjepa2_ac.decoding.training import train_decoder
from vjepa2_ac.encoding.latent_cache import EncoderOnDevice, encode_files
from vjepa2_ac.model.checkpoints import load_base

OPTIONS = {"size": "tiny", "frames": 40, "steps": 6, "batch_size": 4, "learning_rate": 2e-3}
EncodeSplit = Callable[..., FramePairs]


@pytest.fixture
def make_decoder(make_config: MakeConfig, tmp_path: Path) -> MakeConfig:
    """A function that returns the config of a tiny decoder, with changed decoder options and other config keys."""

    def make(folder: str = "decoder", options: dict | None = None, **changes: object) -> Config:
        return make_config(decoder={**OPTIONS, "folder": str(tmp_path / folder), **(options or {})}, **changes)

    return make


@pytest.fixture(scope="session")
def whole_decoder(tmp_path_factory: pytest.TempPathFactory, data_folder: Path, base_folder: Path) -> Path:
    """The folder of the decoder of `make_decoder()`, trained without interruption; tests must not change it."""
    folder = tmp_path_factory.mktemp("whole") / "decoder"
    with one_thread():
        return train_decoder(
            tiny_config(folder.parent / "run", data_folder, base_folder, decoder={**OPTIONS, "folder": str(folder)})
        )


@pytest.fixture
def encode_split(tmp_path: Path) -> EncodeSplit:
    """Return a function that encodes frames of a split, as the training of a decoder does."""

    def encode(config: Config, split: str = "train", frames: int = 40, folder: str = "pairs") -> FramePairs:
        dataset = open_dataset(config.data)
        model = load_base(config.model, seed=config.seed)
        encoder = EncoderOnDevice.from_model(config, model, torch.device("cpu"))
        requests = select_frames(dataset, split, frames=frames)  # type: ignore[arg-type]
        files = LatentFiles(tmp_path / folder, "key")
        encode_files(dataset, requests, encoder, files, lossless_images=True)
        return FramePairs.from_files(dataset, requests, files)

    return encode
