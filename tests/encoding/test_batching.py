"""Encoder batching: all chunks have the same shape, and an unreadable episode does not affect others."""

import weakref
from collections.abc import Callable, Iterator

import numpy as np
import pytest
import torch

from memory_source import MemorySource
from recording_cuda import RecordingCuda, recorded_copies
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data import dataset
from vjepa2_ac.data.streams import NO_COPIES
from vjepa2_ac.encoding.batching import Chunks, Encoded
from vjepa2_ac.encoding.disk_space import FRAMES_AT_ONCE
from vjepa2_ac.encoding.prefetch import FramesToEncode, Part, Unreadable, prefetched
from vjepa2_ac.episode import Episode, EpisodeInfo, StoredLatents
from vjepa2_ac.errors import InputError, UnreachableError

CHUNK = 4


def recording(number: int) -> Episode:
    return Episode(EpisodeInfo(str(number), 99), np.zeros((99, 7)), lambda _: np.zeros((1, 2, 2, 3), np.uint8), 15.0)


def part(wanted: FramesToEncode, first: int, last: int) -> Part:
    """Return frames whose pixels are ten times the episode and the step."""
    values = 10 * wanted.episode + wanted.steps[first:last]
    frames = np.tile(values[:, None, None, None].astype(np.uint8), (1, 2, 2, 3))
    return Part(wanted, recording(wanted.episode), frames, frames)


class Brightness:
    """Encodes a frame as the grey of its frame, and remembers the shapes it was given."""

    def __init__(self, *, scales: bool) -> None:
        self.given: list[tuple[int, ...]] = []
        self._scales = scales

    def __call__(self, inputs: torch.Tensor) -> StoredLatents:
        self.given.append(tuple(inputs.shape))
        grey = (inputs[:, 0, 0, 0] * 0.229 * 255 + 0.485 * 255).round()
        return StoredLatents(
            grey[:, None, None].expand(-1, 3, 2), grey[:, None].expand(-1, 3) if self._scales else None
        )


def wanted(number: int, frames: int) -> FramesToEncode:
    return FramesToEncode(number, "left", np.arange(frames, dtype=np.int32))


def encoded(encode: Brightness, parts: list[Part | Unreadable]) -> list[Encoded | Unreadable]:
    return list(Chunks(encode, chunk=CHUNK, image_size=2, copies=NO_COPIES).encoded(parts))


@pytest.mark.parametrize("scales", [False, True])
def test_each_episode_gets_its_own_frames_back_from_chunks_of_one_shape(scales: bool) -> None:
    lengths = [5, 1, 9, 2]
    all_wanted = [wanted(number, frames) for number, frames in enumerate(lengths)]
    parts = [
        part(one, start, min(start + 3, len(one.steps))) for one in all_wanted for start in range(0, len(one.steps), 3)
    ]
    encode = Brightness(scales=scales)
    done = encoded(encode, parts)
    assert [one.wanted for one in done] == all_wanted
    for number, one in enumerate(done):
        expected = 10 * number + np.arange(lengths[number])
        assert one.latents.values[:, 2, 1].tolist() == expected.tolist()
        assert one.small_frames[:, 0, 0, 0].tolist() == expected.tolist()
        assert one.recording.info.id == str(number)
        assert (one.latents.scales is not None) == scales
        if scales:
            assert one.latents.scales[:, 0].tolist() == expected.tolist()
    assert set(encode.given) == {(CHUNK, 3, 2, 2)}
    assert len(encode.given) == -(-sum(lengths) // CHUNK)  # full, but for the last one


def test_an_episode_that_breaks_half_way_leaves_the_others_whole() -> None:
    first, broken, last = wanted(0, 3), wanted(1, 6), wanted(2, 6)
    error = Unreadable(broken, InputError(where="x", found="damaged"))
    done = encoded(Brightness(scales=False), [part(first, 0, 3), part(broken, 0, 3), error, part(last, 0, 6)])
    assert [one.wanted for one in done if isinstance(one, Unreadable)] == [broken]
    assert [one.wanted for one in done if isinstance(one, Encoded)] == [first, last]
    assert done[-1].latents.values[:, 0, 0].tolist() == [20, 21, 22, 23, 24, 25]


# ---- copies beside the encoder -------------------------------------------------------------------------------------


class Enqueued(Brightness):
    """Records that a chunk is encoded."""

    def __init__(self, cuda: RecordingCuda) -> None:
        super().__init__(scales=True)
        self._cuda = cuda

    def __call__(self, inputs: torch.Tensor) -> StoredLatents:
        self._cuda.calls.append("computing: encode")
        return super().__call__(inputs)


def test_the_next_chunk_is_encoded_while_the_one_before_it_comes() -> None:
    one, cuda = wanted(0, 3 * CHUNK), RecordingCuda()
    parts = [part(one, first, first + CHUNK) for first in range(0, 3 * CHUNK, CHUNK)]
    chunks = Chunks(Enqueued(cuda), chunk=CHUNK, image_size=2, copies=recorded_copies(cuda))
    (found,) = chunks.encoded(parts)
    (expected,) = encoded(Brightness(scales=True), parts)
    assert torch.equal(found.latents.values, expected.latents.values)
    assert torch.equal(found.latents.scales, expected.latents.scales)

    def chunk(event: int) -> list[str]:
        return [
            "side 1: to pinned memory", "side 1: to device", f"side 1: event {event}",
            f"computing: waits for event {event}", "memory in use by computing", "computing: encode",
            f"computing: event {event + 1}", f"side 2: waits for event {event + 1}",
            *["memory in use by side 2", "side 2: to pinned memory"] * 2, f"side 2: event {event + 2}",
        ]  # fmt: skip

    assert cuda.calls == [
        *chunk(1), *chunk(4), "host: waits for event 3", *chunk(7), "host: waits for event 6",
        "host: waits for event 9",
    ]  # fmt: skip


def test_no_pinned_memory_is_held_until_an_episode_is_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.Tensor, "is_pinned", lambda _: True)
    one, cuda, made = wanted(0, 3 * CHUNK), RecordingCuda(), list[weakref.ref[torch.Tensor]]()

    def pinned_copy(tensor: torch.Tensor) -> torch.Tensor:
        copy = tensor.clone()
        made.append(weakref.ref(copy.untyped_storage()))
        return copy

    def parts() -> Iterator[Part]:
        for first in range(0, 3 * CHUNK, CHUNK):
            yield part(one, first, first + CHUNK)
            alive.append(sum(storage() is not None for storage in made))

    alive: list[int] = []
    monkeypatch.setattr(cuda, "pinned_copy", pinned_copy)
    list(Chunks(Brightness(scales=False), chunk=CHUNK, image_size=2, copies=recorded_copies(cuda)).encoded(parts()))
    assert len(made) == 3
    assert alive == [1, 1, 1], "of the chunk that is under way"


# ---- decoding ahead ----------------------------------------------------------------------------------------------


Ahead = Callable[..., Iterator[Part | Unreadable]]


@pytest.fixture
def ahead(monkeypatch: pytest.MonkeyPatch) -> Ahead:
    """Decode every step of a source."""

    def decode(source: MemorySource, threads: int = 2) -> Iterator[Part | Unreadable]:
        monkeypatch.setattr(dataset, "open_source", lambda _: source)
        opened = dataset.open_dataset(DataConfig(path="memory", crop="letterbox"))
        everything = [wanted(number, frames) for number, frames in enumerate(source.lengths)]
        return prefetched(opened, everything, threads=threads, side=2)

    return decode


@pytest.mark.parametrize("threads", [1, 3])
def test_frames_come_in_the_order_in_which_they_are_wanted_and_are_read_once(ahead: Ahead, threads: int) -> None:
    lengths = [FRAMES_AT_ONCE + 1, 3, 2 * FRAMES_AT_ONCE]
    source = MemorySource(lengths)
    parts = list(ahead(source, threads))
    seen = [(int(frame[2, 2, 0]), int(frame[2, 2, 1])) for one in parts for frame in one.frames]
    assert [len(one.frames) for one in parts] == [FRAMES_AT_ONCE, 1, 3, FRAMES_AT_ONCE, FRAMES_AT_ONCE]
    expected = [(number, step) for number, frames in enumerate(lengths) for step in range(frames)]
    assert seen == sorted(source.decoded) == expected
    assert sorted(index for index, _, _ in source.reads) == [0, 1, 2]


def test_unreadable_episode_is_reported_once_and_the_next_ones_follow(ahead: Ahead) -> None:
    long = FRAMES_AT_ONCE * 3
    found = list(ahead(MemorySource([long, long, 2], unreadable=frozenset({0}), pictureless=frozenset({1}))))
    assert [type(one) for one in found] == [Unreadable, Unreadable, Part]
    assert ["memory: episode 0" in str(found[0].error), "pictures of episode 1" in str(found[1].error)] == [True, True]


def test_a_network_that_is_gone_is_no_fault_of_an_episode(ahead: Ahead) -> None:
    source = MemorySource(
        [2], unreadable=frozenset({0}), fault=lambda where: UnreachableError(where=where, found="gone")
    )
    with pytest.raises(UnreachableError):
        list(ahead(source))
