"""Single clips of a data set, and the split of a single name."""

from vjepa2_ac.config import DataConfig
from vjepa2_ac.config.data import Split
from vjepa2_ac.data.clips.clip_reader import ClipRequest, read_clip
from vjepa2_ac.data.clips.dataset import Dataset
from vjepa2_ac.data.index import identity_hash
from vjepa2_ac.episode import Clip


def clip_at(dataset: Dataset, episode: int, start: int, *, camera: str | None = None) -> Clip:
    """Return the clip that starts at a control step of an episode."""
    return read_clip(dataset, ClipRequest(episode, start, camera))


def split_of(name: str, config: DataConfig) -> Split:
    """Return the split of an episode or group: the law, written a second time."""
    number = identity_hash(name) / 2**64
    if number < config.test_share:
        return "test"
    return "validation" if number < config.test_share + config.validation_share else "train"
