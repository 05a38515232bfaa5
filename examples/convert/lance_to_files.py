"""Write a LeRobot data set that is stored as Lance tables as the Parquet and MP4 files it was made of.

    pip install pylance
    python lance_to_files.py FOLDER data/as_files

FOLDER has frames.lance, videos.lance, and meta (or meta.lance), whose info.json says storage_format: lance, as
lerobot-lancedb writes it. Nothing is decoded: videos are copied byte for byte.
"""

import json
import sys
from pathlib import Path
from typing import Any

import lance
import pyarrow as pa
import pyarrow.compute as pc
from pyarrow import parquet

INFO = "meta/info.json"


def write_meta(source: Path, out: Path) -> dict[str, Any]:
    """Write the files of meta; return the content of info.json, which no longer says lance."""
    stored = [path for path in (source / "meta").rglob("*") if path.is_file()]
    files = {path.relative_to(source / "meta"): path.read_bytes() for path in stored}
    if not files and (source / "meta.lance").exists():  # as a remote copy has it
        rows = lance.dataset(str(source / "meta.lance")).to_table().to_pylist()
        files = {Path(row["path"]): row["data"] for row in rows}
    if Path("info.json") not in files:
        raise SystemExit(f"{source}: no {INFO}")
    info: dict[str, Any] = json.loads(files[Path("info.json")])
    if info.pop("storage_format", "lance") != "lance":
        raise SystemExit(f"{source / INFO}: not stored as Lance tables")
    files[Path("info.json")] = json.dumps(info, indent=4).encode()
    for name, data in files.items():
        if name.is_absolute() or ".." in name.parts:
            raise SystemExit(f"{source}: a file of meta called {name}")
        (out / "meta" / name).parent.mkdir(parents=True, exist_ok=True)
        (out / "meta" / name).write_bytes(data)
    return info


def write_rows(source: Path, out: Path, info: dict[str, Any]) -> None:
    """Write the tables of rows; columns get their names back: observation_state is observation.state."""
    names = {name.replace(".", "_"): name for name in info["features"]}
    frames = lance.dataset(str(source / "frames.lance"))
    episodes = pa.concat_tables(
        parquet.read_table(path, columns=["episode_index", "data/chunk_index", "data/file_index"])
        for path in sorted((out / "meta/episodes").rglob("*.parquet"))
    ).to_pylist()
    files: dict[tuple[int, int], list[int]] = {}
    for row in episodes:
        files.setdefault((row["data/chunk_index"], row["data/file_index"]), []).append(row["episode_index"])
    for (chunk, number), members in files.items():
        table = frames.to_table(filter=f"episode_index >= {min(members)} AND episode_index <= {max(members)}")
        table = table.rename_columns([names.get(name, name) for name in table.column_names])
        path = out / str(info["data_path"]).format(chunk_index=chunk, file_index=number)
        path.parent.mkdir(parents=True, exist_ok=True)
        parquet.write_table(table.take(pc.sort_indices(table, [("index", "ascending")])), path)
        print(path)


def write_videos(source: Path, out: Path, info: dict[str, Any]) -> None:
    """Write the videos, byte for byte."""
    if not (source / "videos.lance").exists():
        return
    videos = lance.dataset(str(source / "videos.lance"))
    rows = videos.to_table(columns=["video_key", "chunk_index", "file_index"]).to_pylist()
    for place, row in enumerate(rows):
        path = out / str(info["video_path"]).format(**row)
        path.parent.mkdir(parents=True, exist_ok=True)
        blob: Any = videos.take_blobs("video_bytes", indices=[place])[0]
        with blob:
            path.write_bytes(blob.readall())
        print(path)


def main(source: str, out: str) -> None:
    """Write meta, rows and videos."""
    if Path(out).exists():
        raise SystemExit(f"{out}: exists. Expected a new folder.")
    info = write_meta(Path(source), Path(out))
    write_rows(Path(source), Path(out), info)
    write_videos(Path(source), Path(out), info)
    print(f"Next: vjepa2-ac init {out}")


if __name__ == "__main__":
    if len(sys.argv) != 3:
        raise SystemExit(__doc__)
    main(*sys.argv[1:])
