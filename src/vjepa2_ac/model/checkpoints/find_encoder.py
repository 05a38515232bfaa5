"""Which encoder does `model.encoder` name? A file, a folder, or a repository of the Hub."""

from __future__ import annotations

import logging
from pathlib import Path

from pydantic import ValidationError

from vjepa2_ac.config import EncoderSizes, ModelSizes
from vjepa2_ac.config.model import EncoderConfig
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.base_model import find_encoder_path
from vjepa2_ac.model.checkpoints.encoder_file import FoundEncoder, encoder_in_file, with_frame_path
from vjepa2_ac.model.checkpoints.encoder_folder import encoder_in_folder
from vjepa2_ac.model.checkpoints.meta_file import open_file
from vjepa2_ac.model.checkpoints.published import published_as
from vjepa2_ac.model.sizes import check_sizes
from vjepa2_ac.storage.hub import from_hub
from vjepa2_ac.storage.structured import message_of

logger = logging.getLogger(__name__)

_NEEDED = "an encoder of V-JEPA 2 or 2.1: Meta's .pt, a transformers folder, or a model of this project"
_FIX = "`vjepa2-ac download --list` shows those that are published"
_FILES = ["config.json", "*.safetensors", "*.safetensors.index.json"]


def find_encoder(config: EncoderConfig) -> FoundEncoder:
    """Return the encoder that a config names; of the Hub it is downloaded first. No weight is read.

    Raises:
        InputError: There is none, it is of another kind or damaged, or the config contradicts it.
        UnreachableError: The Hub cannot be reached, and the repository is not in its cache.
    """
    path = find_encoder_path(config.path)
    if path is None:
        folder = from_hub(config.path, _FILES, where=f"model.encoder.path: {config.path}")
        return encoder_in_folder(folder, config, name=config.path)
    if path.is_dir():
        return encoder_in_folder(path, config, name=path.name)
    return encoder_in_file(path, open_file(path, needed=_NEEDED, fix=_FIX), config)


def sizes_with(found: FoundEncoder, given: ModelSizes) -> ModelSizes:
    """Return the sizes of a model with this encoder, at the given image size.

    Raises:
        InputError: The given sizes contradict those of the file, or do not fit its patches or heads.
    """
    own = {"encoder": found.sizes.model_dump(), "patch_size": found.patch_size}
    try:
        sizes = ModelSizes.model_validate(given.model_dump() | own)
    except ValidationError as error:
        raise InputError(where=found.where, found=message_of(error.errors()[0]), needed=_NEEDED) from None
    check_sizes(sizes, given, where=found.where)
    if found.image_size not in {None, given.image_size}:
        logger.warning(
            "%s was trained at %d px, and frames are encoded at %d px (image_size): other positions than it knows",
            found.origin, found.image_size, given.image_size,
        )  # fmt: skip
    return sizes


def expected_sizes(config: EncoderConfig, given: ModelSizes) -> ModelSizes:
    """Return the sizes of a model with this encoder; of a published file that is not here yet, from its name.

    Raises:
        InputError: As `find_encoder`.
    """
    known = published_as(Path(config.path).name)
    if known is None or Path(config.path).exists():
        return sizes_with(find_encoder(config), given)
    shape = known.encoder
    sizes = EncoderSizes(
        width=shape.width, depth=shape.depth, heads=shape.heads, mlp_ratio=shape.mlp_ratio, family=known.family
    )
    encoder = with_frame_path(sizes, config.frame, where=config.path)
    return given.model_copy(update={"encoder": encoder})
