"""Make .npz episodes of ROS bags (ROS 2: .db3 or .mcap, ROS 1: .bag), without ROS: `pip install rosbags`.

    python ros2_bag.py BAGS                      # lists the topics of the first bag
    python ros2_bag.py BAGS --out data/my_robot --rate 10 \
        --camera side=/camera/color/image_raw/compressed --pose /franka/current_pose \
        --gripper /gripper/joint_states:position --gripper-open 0.08 --gripper-closed 0

BAGS is a bag, or a folder of bags: each becomes an episode. TOPIC:FIELD names a part of a message, such as
/robot_state:o_t_ee. A pose is any message with a position and an orientation, alone or inside (PoseStamped, Odometry,
TransformStamped), of the flange in the frame of the robot's base, or 16 numbers: a 4x4 matrix by columns (FrankaState).
Several numbers of a gripper, such as those of two fingers, are added. Every 1/RATE seconds a step is made of each
topic's newest message; a topic that is silent for longer than MOST_SILENT steps ends the conversion.
"""

import argparse
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

MOST_SILENT = 5
CHANNELS = {"rgb8": [0, 1, 2], "bgr8": [2, 1, 0], "rgba8": [0, 1, 2], "bgra8": [2, 1, 0], "mono8": [0, 0, 0]}
ENDS = {".db3", ".mcap", ".bag"}


def bags_in(path: Path) -> list[Path]:
    """Return the bags at a path: files, or folders with a metadata.yaml."""
    if path.suffix in ENDS or (path / "metadata.yaml").exists():
        return [path]
    inner = sorted(path.iterdir()) if path.is_dir() else []
    return [bag for one in inner if one.is_dir() or one.suffix in ENDS for bag in bags_in(one)]


def opened(bag: Path) -> AnyReader:
    """Return a reader; bags that do not describe their messages are taken for ROS 2 Humble's."""
    return AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_HUMBLE))


def image_of(message: Any, height: int, where: str) -> np.ndarray:
    """Return the RGB image of an Image or CompressedImage, [height, width, 3] of uint8."""
    if hasattr(message, "encoding"):
        if message.encoding not in CHANNELS:
            raise SystemExit(f"{where}: images of {message.encoding}; read are {', '.join(CHANNELS)} (depth is not)")
        rows = np.asarray(message.data, np.uint8).reshape(message.height, message.step)
        depth = max(CHANNELS[message.encoding]) + 1 + message.encoding.endswith("a8")
        pixels = rows[:, : message.width * depth].reshape(message.height, message.width, depth)
        image = Image.fromarray(np.ascontiguousarray(pixels[..., CHANNELS[message.encoding]]))
    else:
        image = Image.open(io.BytesIO(bytes(message.data))).convert("RGB")
    return np.asarray(image.resize((round(height * image.width / image.height), height), Image.Resampling.LANCZOS))


def pose_of(value: Any, where: str) -> np.ndarray:
    """Return x, y, z (metres), roll, pitch, yaw (radians) of a message with a pose, or of 16 numbers."""
    while (inner := getattr(value, "pose", getattr(value, "transform", None))) is not None:
        value = inner
    if np.size(value) == 16:
        matrix = np.reshape(np.asarray(value, float), (4, 4), order="F")
        return np.concatenate([matrix[:3, 3], Rotation.from_matrix(matrix[:3, :3]).as_euler("xyz")])
    at: Any = getattr(value, "position", getattr(value, "translation", None))
    turned: Any = getattr(value, "orientation", getattr(value, "rotation", None))
    if not hasattr(at, "x") or not hasattr(turned, "w"):
        raise SystemExit(f"{where}: {type(value).__name__} is no pose; name the field with TOPIC:FIELD")
    angles = Rotation.from_quat([turned.x, turned.y, turned.z, turned.w]).as_euler("xyz")
    return np.array([at.x, at.y, at.z, *angles])


def opening_of(value: Any, where: str) -> float:
    """Return the number of a gripper; several are added."""
    value = getattr(value, "data", value)
    try:
        return float(np.sum(np.asarray(value, float)))
    except (TypeError, ValueError):
        raise SystemExit(f"{where}: {type(value).__name__} is no number; name the field with TOPIC:FIELD") from None


def connections_of(reader: AnyReader, topic: str, bag: Path) -> list[Any]:
    """Return where a bag has a TOPIC or TOPIC:FIELD."""
    name = topic.partition(":")[0]
    connections = [one for one in reader.connections if one.topic == name]
    if not connections:
        raise SystemExit(f"{bag}: no topic {name}; it has {', '.join(sorted(reader.topics))}")
    return connections


def times_of(reader: AnyReader, topic: str, bag: Path) -> np.ndarray:
    """Return the times of a topic's messages in seconds."""
    return np.array([time_ns / 1e9 for _, time_ns, _ in reader.messages(connections_of(reader, topic, bag))])


def messages_of(reader: AnyReader, topic: str, bag: Path, places: np.ndarray) -> Iterator[Any]:
    """Yield the messages of a TOPIC or TOPIC:FIELD at these places, which rise or repeat."""
    wanted, field = iter(places.tolist()), topic.partition(":")[2]
    following = next(wanted, None)
    for place, (connection, _, data) in enumerate(reader.messages(connections_of(reader, topic, bag))):
        if place != following:
            continue
        value = reader.deserialize(data, connection.msgtype)
        for part in filter(None, field.split(".")):
            if not hasattr(value, part):
                raise SystemExit(f"{bag}: {topic}: {connection.msgtype} has no {part}; it has {', '.join(vars(value))}")
            value = getattr(value, part)
        while place == following:
            yield value
            following = next(wanted, None)


def newest(times: np.ndarray, steps: np.ndarray, where: str) -> np.ndarray:
    """Return the place of the newest message at each step."""
    places = np.searchsorted(times, steps, side="right") - 1
    silent = float((steps - times[places]).max())
    if silent > MOST_SILENT * (steps[1] - steps[0]):
        raise SystemExit(f"{where}: silent for {silent:.2f} s; lower --rate, or cut the bag")
    return places


def episode_of(bag: Path, cameras: dict[str, str], args: argparse.Namespace) -> dict[str, Any]:
    """Return the arrays of one episode."""
    topics = [*cameras.values(), args.pose, args.gripper]
    with opened(bag) as reader:
        times = [times_of(reader, topic, bag) for topic in topics]
        if short := [topic for topic, its in zip(topics, times, strict=True) if len(its) < 2]:
            raise SystemExit(f"{bag}: fewer than two messages of {', '.join(short)}")
        steps = np.arange(max(its[0] for its in times), min(its[-1] for its in times), 1 / args.rate)
        if len(steps) < 2:
            raise SystemExit(f"{bag}: the topics are together for less than two steps")
        places = [newest(its, steps, f"{bag}: {topic}") for topic, its in zip(topics, times, strict=True)]
        found = [messages_of(reader, topic, bag, its) for topic, its in zip(topics, places, strict=True)]
        arrays: dict[str, Any] = {"fps_hz": args.rate}
        for (name, topic), messages in zip(cameras.items(), found, strict=False):
            arrays[name] = np.stack([image_of(one, args.height, f"{bag}: {topic}") for one in messages])
        poses = np.stack([pose_of(one, f"{bag}: {args.pose}") for one in found[-2]])
        grips = [opening_of(one, f"{bag}: {args.gripper}") for one in found[-1]]
    closedness = (np.array(grips) - args.gripper_open) / (args.gripper_closed - args.gripper_open)
    if closedness.min() < -0.1 or closedness.max() > 1.1:
        ends = f"{min(grips):.4g} to {max(grips):.4g}"
        raise SystemExit(f"{bag}: {args.gripper} goes from {ends}: set --gripper-open and --gripper-closed")
    arrays["states"] = np.concatenate([poses, closedness.clip(0, 1)[:, None]], axis=1)
    return arrays | ({"language": args.language} if args.language else {})


def list_topics(bag: Path) -> None:
    """Print the topics of a bag, with their types and rates."""
    with opened(bag) as reader:
        seconds = max(reader.duration / 1e9, 1e-9)
        for name, topic in sorted(reader.topics.items()):
            print(f"{name}  {topic.msgtype}  {topic.msgcount / seconds:.1f} a second")


def main() -> None:
    """Write an .npz file for each bag."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bags", type=Path)
    parser.add_argument("--out", type=Path, help="a folder for NAME.npz; without it, topics are listed")
    parser.add_argument("--camera", action="append", default=[], metavar="NAME=TOPIC", help="may be repeated")
    parser.add_argument("--pose", metavar="TOPIC[:FIELD]")
    parser.add_argument("--gripper", metavar="TOPIC[:FIELD]")
    parser.add_argument("--gripper-open", type=float, default=0.0, help="its number when open")
    parser.add_argument("--gripper-closed", type=float, default=1.0, help="its number when closed")
    parser.add_argument("--rate", type=float, default=10.0, help="steps a second")
    parser.add_argument("--height", type=int, default=256, help="of stored frames; the model looks at 256")
    parser.add_argument("--language", help="what was done")
    args = parser.parse_args()
    bags = bags_in(args.bags)
    if not bags:
        raise SystemExit(f"{args.bags}: no bags ({', '.join(sorted(ENDS))}, or folders with a metadata.yaml)")
    if args.out is None:
        list_topics(bags[0])
        return
    if not (args.camera and args.pose and args.gripper) or any("=" not in one for one in args.camera):
        parser.error("--out needs --camera NAME=TOPIC, --pose TOPIC and --gripper TOPIC")
    for number, bag in enumerate(bags):
        arrays = episode_of(bag, dict(one.split("=", 1) for one in args.camera), args)
        out = args.out / f"{bag.stem if bag.suffix in ENDS else bag.name}.npz"
        out.parent.mkdir(parents=True, exist_ok=True)
        np.savez(out, **arrays)
        print(f"{number + 1} of {len(bags)}: {out}, {len(arrays['states'])} steps")
    print(f"Next: vjepa2-ac init npz {args.out}")


if __name__ == "__main__":
    main()
