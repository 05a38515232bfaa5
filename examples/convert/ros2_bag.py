"""Convert ROS bags (ROS 2: .db3 or .mcap, ROS 1: .bag) to .npz episodes, without ROS: `pip install rosbags`.

    python ros2_bag.py BAGS                      # lists the topics of the first bag
    python ros2_bag.py BAGS --out data/my_robot --rate 10 \
        --camera side=/camera/color/image_raw/compressed --pose /franka/current_pose \
        --gripper '/joint_states:position[finger_joint1]' --gripper-open 0.04 --gripper-closed 0

BAGS is a bag, or a folder of bags: each becomes an episode. TOPIC:FIELD names a part of a message, such as
/robot_state:o_t_ee.

The pose is that of the flange in the frame of the robot's base: any message with a position and an orientation, alone
or inside (PoseStamped, Odometry, TransformStamped), or 16 numbers, a 4x4 matrix by columns (FrankaState).

The gripper is a number. TOPIC:FIELD[NAME] or TOPIC:FIELD[NUMBER] selects a joint of several; [NAME,NAME] adds two.
Without brackets all numbers are added. This is refused if more than two move, or two that do not move together.

Every 1/RATE seconds a step is made of each topic's newest message. Messages without a measurement (an orientation or a
pose of zeros, NaN, other joints than the selected ones) are left out and counted. A topic that is silent for longer
than MOST_SILENT steps ends the conversion.
"""

import argparse
import io
import itertools
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

MOST_SILENT = 5
CHANNELS = {"rgb8": [0, 1, 2], "bgr8": [2, 1, 0], "rgba8": [0, 1, 2], "bgra8": [2, 1, 0], "mono8": [0, 0, 0]}
ENDINGS = {".db3", ".mcap", ".bag"}


def find_bags(path: Path) -> list[Path]:
    """Return the bags at a path: files, or folders with a metadata.yaml. The ._NAME files of macOS are ignored."""
    if path.suffix in ENDINGS or (path / "metadata.yaml").exists():
        return [path]
    entries = sorted(path.iterdir()) if path.is_dir() else []
    entries = [entry for entry in entries if not entry.name.startswith("._")]
    return [bag for entry in entries if entry.is_dir() or entry.suffix in ENDINGS for bag in find_bags(entry)]


@contextmanager
def open_bag(bag: Path) -> Iterator[AnyReader]:
    """Open a bag; one without message definitions is read with those of ROS 2 Humble."""
    try:
        with AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            yield reader
    except AnyReaderError as error:
        raise SystemExit(f"{bag}: not a readable bag ({error})") from None


def decode_image(message: Any, height: int, where: str) -> np.ndarray:
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


def read_pose(value: Any, names: list[str], where: str) -> np.ndarray:  # noqa: ARG001 - as `read_gripper`
    """Return x, y, z (metres), roll, pitch, yaw (radians) of a message with a pose, or of 16 numbers; NaN if empty."""
    while (inner := getattr(value, "pose", getattr(value, "transform", None))) is not None:
        value = inner
    if np.size(value) == 16:
        matrix = np.reshape(np.asarray(value, float), (4, 4), order="F")
        position, numbers = matrix[:3, 3], matrix[:3, :3]
    else:
        point: Any = getattr(value, "position", getattr(value, "translation", None))
        turn: Any = getattr(value, "orientation", getattr(value, "rotation", None))
        if not hasattr(point, "x") or not hasattr(turn, "w"):
            raise SystemExit(f"{where}: {type(value).__name__} is no pose; name the field with TOPIC:FIELD")
        position, numbers = np.array([point.x, point.y, point.z]), np.array([turn.x, turn.y, turn.z, turn.w])
    if not numbers.any() or not np.isfinite(numbers).all():
        return np.full(6, np.nan)
    size = np.linalg.norm(numbers) if numbers.ndim == 1 else np.linalg.det(numbers)
    if abs(size - 1) > 0.01:
        raise SystemExit(f"{where}: the rotation {numbers.tolist()}. Expected a unit quaternion or a rotation matrix.")
    rotation = Rotation.from_quat(numbers) if numbers.ndim == 1 else Rotation.from_matrix(numbers)
    pose = np.concatenate([position, rotation.as_euler("xyz")])
    return pose if pose.any() else np.full(6, np.nan)


def read_gripper(value: Any, names: list[str], where: str, selected: list[str]) -> np.ndarray:
    """Return the numbers of a gripper, or of the selected joints; NaN if the message does not have these."""
    try:
        numbers = np.ravel(np.asarray(getattr(value, "data", value), float))
    except (TypeError, ValueError):
        raise SystemExit(f"{where}: {type(value).__name__} is no number; name the field with TOPIC:FIELD") from None
    if not selected:
        return numbers
    indices = {str(index): index for index in range(len(numbers))} | dict(zip(names, range(len(numbers)), strict=False))
    return np.array([numbers[indices[joint]] if joint in indices else np.nan for joint in selected])


def find_connections(reader: AnyReader, topic: str, bag: Path) -> list[Any]:
    """Return the connections of a bag that have a TOPIC, TOPIC:FIELD or TOPIC:FIELD[JOINT]."""
    name = re.split(r"[:\[]", topic)[0]
    connections = [connection for connection in reader.connections if connection.topic == name]
    if not connections:
        raise SystemExit(f"{bag}: no topic {name}; it has {', '.join(sorted(reader.topics))}")
    return connections


def read_times(reader: AnyReader, topic: str, bag: Path) -> np.ndarray:
    """Return the times of a topic's messages in seconds."""
    return np.array([time_ns / 1e9 for _, time_ns, _ in reader.messages(find_connections(reader, topic, bag))])


def read_values(reader: AnyReader, topic: str, bag: Path, indices: Iterable[int]) -> Iterator[tuple[Any, list[str]]]:
    """Yield the field of a topic's messages at these indices, which rise or repeat, and the names of its joints."""
    field, remaining = topic.partition("[")[0].partition(":")[2], iter(indices)
    following = next(remaining, None)
    for index, (connection, _, data) in enumerate(reader.messages(find_connections(reader, topic, bag))):
        if index != following:
            continue
        names, value = [], reader.deserialize(data, connection.msgtype)
        for part in filter(None, field.split(".")):
            if not hasattr(value, part):
                raise SystemExit(f"{bag}: {topic}: {connection.msgtype} has no {part}; it has {', '.join(vars(value))}")
            names, value = list(getattr(value, "name", [])), getattr(value, part)
        while index == following:
            yield value, names
            following = next(remaining, None)


def read_measurements(
    reader: AnyReader, topic: str, bag: Path, convert: Callable[[Any, list[str], str], np.ndarray]
) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Return times and numbers, [messages, numbers], of the messages that have a measurement, and names of joints."""
    times, rows, names = read_times(reader, topic, bag), list[np.ndarray](), list[str]()
    seconds = times - reader.start_time / 1e9
    for second, (value, names) in zip(seconds, read_values(reader, topic, bag, itertools.count()), strict=False):
        rows.append(convert(value, names, f"{bag}: {topic} at {second:.2f} s"))
    is_measured = np.array([len(row) > 0 and bool(np.isfinite(row).all()) for row in rows])
    if not is_measured.all():
        found = f"{(~is_measured).sum()} of {len(rows)} messages have no measurement (zeros, NaN or other joints)"
        print(f"warning: {bag}: {topic}: {found} and are left out, the first at {seconds[~is_measured][0]:.2f} s")
    measured = [row for row, is_one in zip(rows, is_measured, strict=True) if is_one]
    if len({len(row) for row in measured}) != 1:
        found = "messages have different joints" if measured else "no message has a measurement"
        raise SystemExit(f"{bag}: {topic}: {found}. The joints of the last one: {', '.join(names) or 'none'}.")
    return times[is_measured], np.stack(measured), names


def compute_closedness(numbers: np.ndarray, names: list[str], where: str, options: argparse.Namespace) -> np.ndarray:
    """Return 0 (open) to 1 (closed) for the numbers of a gripper, [steps, joints], which are added."""
    total, span = numbers.sum(axis=1), options.gripper_closed - options.gripper_open
    gripper_position = (total - options.gripper_open) / span
    is_in_range = gripper_position.min() >= -0.1 and gripper_position.max() <= 1.1
    moving = numbers[:, np.ptp(numbers, axis=0) > 0.05 * abs(span)].T
    is_gripper = len(moving) < 2 or (len(moving) == 2 and np.corrcoef(moving)[0, 1] > 0.9)  # two fingers move together
    if "[" not in options.gripper and not (is_gripper and (is_in_range or numbers.shape[1] <= 2)):
        last = numbers.shape[1] - 1
        names = names or [str(index) for index in range(last + 1)]
        found = f"{last + 1} joints, numbered from 0 to {last}: {', '.join(names)}"
        fix = f"Append its name or number to the topic, such as [{names[-1]}]"
        raise SystemExit(f"{where}: {found}. Expected the gripper's joint. {fix}.")
    if not is_in_range:
        ends = f"{total.min():.4g} to {total.max():.4g}"
        raise SystemExit(f"{where} goes from {ends}: set --gripper-open and --gripper-closed")
    return np.asarray(gripper_position.clip(0, 1))


def find_newest(times: np.ndarray, steps: np.ndarray, where: str) -> np.ndarray:
    """Return the index of the newest message at each step."""
    indices = np.searchsorted(times, steps, side="right") - 1
    silent_s = float((steps - times[indices]).max())
    if silent_s > MOST_SILENT * (steps[1] - steps[0]):
        raise SystemExit(f"{where}: silent for {silent_s:.2f} s; lower --rate, or cut the bag")
    return indices


def make_episode(bag: Path, cameras: dict[str, str], options: argparse.Namespace) -> dict[str, Any]:
    """Return the arrays of one episode."""
    topics = [*cameras.values(), options.pose, options.gripper]
    selected = [joint.strip() for joint in options.gripper.partition("[")[2].rstrip("]").split(",") if joint]
    with open_bag(bag) as reader:
        times = [read_times(reader, topic, bag) for topic in cameras.values()]
        pose_times, poses, _ = read_measurements(reader, options.pose, bag, read_pose)
        convert = partial(read_gripper, selected=selected)
        gripper_times, fingers, names = read_measurements(reader, options.gripper, bag, convert)
        times += [pose_times, gripper_times]
        if short := [topic for topic, of_topic in zip(topics, times, strict=True) if len(of_topic) < 2]:
            raise SystemExit(f"{bag}: fewer than two messages of {', '.join(short)}")
        start_s, end_s = max(of_topic[0] for of_topic in times), min(of_topic[-1] for of_topic in times)
        steps = np.arange(start_s, end_s, 1 / options.rate)
        if len(steps) < 2:
            raise SystemExit(f"{bag}: the topics are together for less than two steps")
        indices = [
            find_newest(of_topic, steps, f"{bag}: {topic}") for topic, of_topic in zip(topics, times, strict=True)
        ]
        arrays: dict[str, Any] = {"fps_hz": options.rate}
        for (name, topic), at_steps in zip(cameras.items(), indices, strict=False):
            images = read_values(reader, topic, bag, at_steps.tolist())
            arrays[name] = np.stack([decode_image(image, options.height, f"{bag}: {topic}") for image, _ in images])
    gripper_position = compute_closedness(fingers[indices[-1]], names, f"{bag}: {options.gripper}", options)
    arrays["states"] = np.concatenate([poses[indices[-2]], gripper_position[:, None]], axis=1)
    return arrays | ({"language": options.language} if options.language else {})


def list_topics(bag: Path) -> None:
    """Print the topics of a bag, with their types and rates."""
    with open_bag(bag) as reader:
        seconds = max(reader.duration / 1e9, 1e-9)
        for name, topic in sorted(reader.topics.items()):
            print(f"{name}  {topic.msgtype}  {topic.msgcount / seconds:.1f} per second")


def main() -> None:
    """Write an .npz file for each bag."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bags", type=Path)
    parser.add_argument("--out", type=Path, help="a folder for NAME.npz; without it, topics are listed")
    parser.add_argument("--camera", action="append", default=[], metavar="NAME=TOPIC", help="may be repeated")
    parser.add_argument("--pose", metavar="TOPIC[:FIELD]")
    parser.add_argument("--gripper", metavar="TOPIC[:FIELD][[JOINT]]")
    parser.add_argument("--gripper-open", type=float, default=0.0, help="value of the gripper when open")
    parser.add_argument("--gripper-closed", type=float, default=1.0, help="value of the gripper when closed")
    parser.add_argument("--rate", type=float, default=10.0, help="steps per second")
    parser.add_argument("--height", type=int, default=256, help="height of the stored frames (256, as the model reads)")
    parser.add_argument("--language", help="the task as text")
    args = parser.parse_args()
    bags = find_bags(args.bags)
    if not bags:
        raise SystemExit(f"{args.bags}: no bags ({', '.join(sorted(ENDINGS))}, or folders with a metadata.yaml)")
    if args.out is None:
        list_topics(bags[0])
        return
    if not (args.camera and args.pose and args.gripper) or any("=" not in camera for camera in args.camera):
        parser.error("--out needs --camera NAME=TOPIC, --pose TOPIC and --gripper TOPIC")
    if args.gripper_open == args.gripper_closed or args.rate <= 0:
        parser.error("--gripper-open and --gripper-closed must differ, and --rate must be positive")
    for number, bag in enumerate(bags):
        arrays = make_episode(bag, dict(camera.split("=", 1) for camera in args.camera), args)
        out = args.out / f"{bag.stem if bag.suffix in ENDINGS else bag.name}.npz"
        out.parent.mkdir(parents=True, exist_ok=True)
        np.savez(out, **arrays)
        print(f"{number + 1} of {len(bags)}: {out}, {len(arrays['states'])} steps")
    print(f"Next: vjepa2-ac init {args.out}")


if __name__ == "__main__":
    main()
