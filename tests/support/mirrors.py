"""Runs with small checkpoints, and the remote folders to which they are copied."""

from dataclasses import replace
from pathlib import Path

from vjepa2_ac import storage
from vjepa2_ac.runs.checkpoint import RunState, checkpoint_name, write_checkpoint
from vjepa2_ac.runs.mirror import RemoteCheckpoints, list_complete

REMOTE = "gs://bucket/run"


def write(run: Path, step: int, state: RunState | None = None, keep: int = 3, words: str = "of step") -> Path:
    """Write a checkpoint with two files besides the state; the run id is `mine` if the state has none."""

    def files(folder: Path) -> None:
        (folder / "adapter").mkdir()
        (folder / "adapter/weights.bin").write_bytes(f"{words} {step:04d} ".encode() * 1000)
        (folder / "optimizer.pt").write_bytes(f"{words} {step:04d} ".encode() * 2000)

    state = replace(state or RunState(step), step=step)
    return write_checkpoint(run / "checkpoints", replace(state, run_id=state.run_id or "mine"), files, keep=keep)


def remote_checkpoints(remote: str = REMOTE) -> list[str]:
    """Return the names of the complete checkpoints in a remote folder."""
    return sorted(list_complete(RemoteCheckpoints(remote).list_files()))


def names(*steps: int) -> list[str]:
    return [checkpoint_name(step) for step in steps]


def content(folder: str | Path) -> dict[str, bytes]:
    """Return the content of all files in a remote or local folder."""
    return {name: storage.read_bytes(storage.join(str(folder), name)) for name in storage.file_sizes(str(folder))}
