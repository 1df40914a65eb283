"""Bags in and out: rosbag2 folders and single .mcap or .db3 files, messages in log order.

Custom types are read by the definitions that the bag itself carries, else by this package's own .msg
files; nothing here needs ROS or the generated messages.
"""

from __future__ import annotations

import heapq
import logging
import os
import shutil
import sys
from collections import Counter
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, NamedTuple

from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader
from rosbags.interfaces import (
    MessageDefinitionFormat,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore

from relpose_ros.errors import RelPoseError

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from types import TracebackType

    from rosbags.interfaces import Connection
    from rosbags.interfaces.typing import Typesdict
    from rosbags.typesys.store import Typestore
    from typing_extensions import Self

    from relpose_ros.scanning.incoming import Kind

logger = logging.getLogger("relpose_ros")

OBJECT_VIEW = "relpose_ros/msg/ObjectView"
IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
POSE_STAMPED = "geometry_msgs/msg/PoseStamped"
POSE_WITH_COVARIANCE_STAMPED = "geometry_msgs/msg/PoseWithCovarianceStamped"

CAMERA_POSE_TOPICS = {
    "camera_pose": POSE_STAMPED,
    "camera_pose_with_covariance": POSE_WITH_COVARIANCE_STAMPED,
}
"""The node's own names and types."""

UNKNOWN_HASH = "RIHS01_" + "0" * 64
"""The writer insists on a type hash, an MCAP file has none."""
STORAGE_SUFFIXES = (".mcap", ".db3")
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
"""A serialised message never starts with these bytes (its first one is 0): it was compressed one by one."""


class BagError(RelPoseError):
    """A bag cannot be read or written, or holds nothing to work with."""


class Record(NamedTuple):
    """One message of a bag."""

    topic: str
    log_time_ns: int
    """When it was recorded, nanoseconds."""
    message: Any
    """An object with the message's fields."""


class BagReader:
    """A bag opened for reading; use it as a context manager.

    A recording that broke off (no metadata.yaml, an MCAP file without its end or without anything, a damaged
    database) is read as far as it goes, with a warning in the log.
    """

    def __init__(self, path: Path) -> None:
        """Prepare to read ``path``: a rosbag2 folder, a .mcap or .db3 file, or one of these with .zstd."""
        self.path = Path(path)
        self.topics: dict[str, str] = {}
        """Type of each topic."""
        self.counts: Counter[str] = Counter()
        """Messages on each topic."""
        self.unreadable: Counter[str] = Counter()
        """Messages on each topic that could not be deserialised, so far."""
        self._readers: list[Reader] = []
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        """Open the bag.

        Raises:
            BagError: It is missing, empty, no bag, or damaged beyond use.
        """
        try:
            self._open()
        except BaseException:
            self._stack.close()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Close the bag."""
        self._stack.close()

    def records(self, topics: Iterable[str]) -> Iterator[Record]:
        """Messages of some topics in log order; what cannot be deserialised is counted and left out.

        Raises:
            BagError: A topic's message definition makes no sense.
        """
        wanted = set(topics)
        per_reader = [
            [each for each in reader.connections if each.topic in wanted] for reader in self._readers
        ]
        typestore = self._typestore([each for chosen in per_reader for each in chosen])
        # Unlike a sort, a merge keeps one message of each file in memory, however long the bag.
        streams = [
            self._raw(number, reader, chosen)
            for number, (reader, chosen) in enumerate(zip(self._readers, per_reader, strict=True))
            if chosen
        ]
        for log_time, _, _, connection, data in heapq.merge(*streams, key=lambda item: item[:3]):
            try:
                raw = zstd.decompress(data) if bytes(data[:4]) == ZSTD_MAGIC else data
                message = typestore.deserialize_cdr(raw, connection.msgtype)
            except Exception as err:  # the bytes are anybody's, and so are the errors they cause
                self.unreadable[connection.topic] += 1
                logger.warning(
                    "The message on %s logged at %d ns is no %s (%s); it is left out.",
                    *(connection.topic, log_time, connection.msgtype, err),
                )
                continue
            yield Record(connection.topic, log_time, message)

    def _raw(
        self, number: int, reader: Reader, connections: Sequence[Connection]
    ) -> Iterator[tuple[int, int, int, Connection, bytes]]:
        read = 0
        messages = reader.messages(connections=connections)
        while True:
            try:
                connection, log_time, data = next(messages)
            except StopIteration:
                return
            except Exception as err:  # a damaged file fails in the reader's every layer
                logger.warning(
                    "%s is damaged after %d messages (%s); the rest of it is not read.",
                    *(reader.path, read, str(err).rstrip(".")),
                )
                return
            yield log_time, number, read, connection, data
            read += 1

    def _open(self) -> None:
        path = self.path
        if not path.exists():
            raise BagError(f"{path} does not exist; name a rosbag2 folder, a .mcap or a .db3 file.")
        if path.is_dir():
            self._open_folder()
        elif path.suffix == ".bag":
            text = f"{path} is a ROS 1 bag; convert it first: rosbags-convert --src {path} --dst FOLDER."
            raise BagError(text)
        elif _storage_suffix(path) is None:
            raise BagError(f"{path} is no bag; name a rosbag2 folder, a .mcap or a .db3 file.")
        else:
            self._open_file(path)
        for reader in self._readers:
            for connection in reader.connections:
                self.topics.setdefault(connection.topic, connection.msgtype)
                self.counts[connection.topic] += connection.msgcount
        if not sum(self.counts.values()):
            text = f"{path} is a bag without a message; was anything published while it recorded?"
            raise BagError(text)

    def _open_folder(self) -> None:
        if (self.path / "metadata.yaml").exists():
            try:
                self._readers.append(self._stack.enter_context(Reader(self.path)))
            except Exception as err:  # metadata and storage are parsed in several libraries
                logger.warning(
                    "%s does not open as it is (%s); its files are read one by one.",
                    *(self.path, str(err).rstrip(".")),
                )
            else:
                return
        files = sorted(each for each in self.path.iterdir() if _storage_suffix(each) is not None)
        if not files:
            text = f"{self.path} is no bag: it holds neither a .mcap nor a .db3 file."
            if (self.path / "cameras.json").exists():
                how = f"'relpose_ros pack {self.path} --output BAG'"
                text = f"{self.path} is a capture and no bag: {how} makes one of it."
            raise BagError(text)
        problems = []
        for file in files:
            try:
                self._open_file(file)
            except BagError as err:
                problems.append(err)
        if not self._readers:
            raise problems[0]
        for problem in problems:
            logger.warning("%s It is left out.", problem)

    def _open_file(self, path: Path) -> None:
        if path.stat().st_size == 0:
            raise BagError(f"{path} is empty: nothing was recorded into it.")
        plain = path
        if path.suffix == ".zstd":
            plain = self._temporary_folder() / path.stem
            try:
                with zstd.open(path, "rb") as packed, plain.open("wb") as unpacked:
                    shutil.copyfileobj(packed, unpacked)
            except (zstd.ZstdError, EOFError) as err:
                # What came out before the damage may still hold messages.
                logger.warning("%s does not unpack to its end (%s).", path, err)
        try:
            reader = self._stack.enter_context(Reader(plain))
        except Exception as err:
            if plain.suffix != ".mcap":
                text = f"{path} cannot be read as a bag: {str(err).rstrip('.')}."
                raise BagError(text) from err
            reader = self._salvaged(path, plain, err)
        self._readers.append(reader)

    def _salvaged(self, path: Path, plain: Path, problem: Exception) -> Reader:
        target = self._temporary_folder() / "salvaged"
        try:
            saved = _salvage(plain, target)
        except Exception as err:
            raise BagError(f"{path} cannot be read as a bag: {str(problem).rstrip('.')}.") from err
        if not saved:
            text = (
                f"{path} cannot be read as a bag ({str(problem).rstrip('.')}), "
                "and no whole message is left in it."
            )
            raise BagError(text)
        logger.warning(
            "%s is damaged (%s): the %d messages before the damage are used.",
            *(path, str(problem).rstrip("."), saved),
        )
        return self._stack.enter_context(Reader(target))

    def _temporary_folder(self) -> Path:
        return Path(self._stack.enter_context(TemporaryDirectory(prefix="relpose_ros-")))

    def _typestore(self, connections: Sequence[Connection]) -> Typestore:
        """The types of some connections, by the bag's own definitions where it has them."""
        definitions: Typesdict = {}
        undefined: list[Connection] = []
        for connection in connections:
            text, name = connection.msgdef.data, connection.msgtype
            try:
                if connection.msgdef.format == MessageDefinitionFormat.MSG:
                    definitions.update(get_types_from_msg(text, name))
                elif connection.msgdef.format == MessageDefinitionFormat.IDL:
                    definitions.update(_types_from_idl(text))
                else:
                    undefined.append(connection)
            except TypesysError as err:
                text = f"{self.path} holds a definition of {name} that makes no sense: {err}."
                raise BagError(text) from err
        if undefined:
            definitions = {**_base_store().fielddefs, **definitions}
        for connection in undefined:
            if connection.msgtype not in definitions:
                text = (
                    f"{self.path} does not say what a {connection.msgtype} is (topic {connection.topic}), "
                    "and this package does not know it; record it as MCAP, which embeds the definitions."
                )
                raise BagError(text)
        typestore = get_typestore(Stores.EMPTY)
        typestore.register(definitions)
        return typestore


class BagWriter:
    """A new rosbag2 folder in MCAP format, with the message definitions embedded.

    The same messages give the same bytes. Use it as a context manager.
    """

    def __init__(self, path: Path) -> None:
        """Prepare to write the folder ``path``, which must not exist.

        Raises:
            BagError: It exists.
        """
        if path.exists():
            raise BagError(f"{path} exists already; name another bag or remove it first.")
        self._path = path
        self._typestore = _base_store()
        self._writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
        self._connections: dict[str, Connection] = {}
        self.types = self._typestore.types
        """Message classes by name, to be filled and written."""

    def __enter__(self) -> Self:
        """Create the folder.

        Raises:
            BagError: The file system refuses.
        """
        try:
            self._writer.open()
        except OSError as err:
            raise BagError(f"{self._path} cannot be created: {err.strerror}.") from err
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Write index and metadata; or remove the unfinished bag where an error came up.

        Raises:
            BagError: The file system refuses.
        """
        if error is None:
            try:
                self._writer.close()
            except OSError as err:
                self._remove()
                raise self._not_written(err) from err
        else:
            self._remove()

    def add_topic(self, topic: str, type_name: str, *, latched: bool = False) -> None:
        """Announce a topic; ``latched`` ones are offered to late joiners when the bag is played."""
        self._connections[topic] = self._writer.add_connection(
            topic,
            type_name,
            typestore=self._typestore,
            offered_qos_profiles=[_reliable(latched=latched)],
        )

    def write(self, topic: str, log_time_ns: int, message: object) -> None:
        """Append a message to an announced topic.

        Raises:
            BagError: The file system refuses.
        """
        connection = self._connections[topic]
        data = self._typestore.serialize_cdr(message, connection.msgtype)
        try:
            self._writer.write(connection, log_time_ns, data)
        except OSError as err:
            raise self._not_written(err) from err

    def _not_written(self, err: OSError) -> BagError:
        return BagError(f"{self._path} cannot be written: {err.strerror}.")

    def _remove(self) -> None:
        # What cannot be written may not be closed in good order either.
        with suppress(OSError):
            self._writer.abort()
        shutil.rmtree(self._path, ignore_errors=True)


@dataclass(frozen=True)
class Input:
    """How a topic of a bag enters the scanner."""

    kind: Kind
    camera: str
    """What pairs an image with its camera info: the image topic without its transport."""


def is_bag(path: Path) -> bool:
    """Whether a path is meant as a bag: any file, or a folder with recorded files or their metadata."""
    if not path.is_dir():
        return path.is_file()
    return (path / "metadata.yaml").exists() or any(_storage_suffix(each) for each in path.iterdir())


def choose_inputs(bag: BagReader, wanted: Sequence[str] = ()) -> dict[str, Input]:
    """Which topics of a bag feed the scanner, and as what.

    Without ``wanted``: all ObjectView topics, else the one camera that the bag holds, raw before
    compressed. The camera info is looked for beside the image topic, as image_transport places it, and so
    are the robot's camera poses; where there are none beside it, those of the bag count if they are of one
    camera.

    Args:
        bag: An open bag.
        wanted: Topics of views or images; their camera infos are added.

    Raises:
        BagError: The bag has no such topic, no images, or several cameras to choose from.
    """
    topics = {topic: kind for topic, kind in bag.topics.items() if bag.counts[topic]}
    images = [topic for topic, kind in topics.items() if kind in (OBJECT_VIEW, IMAGE, COMPRESSED_IMAGE)]
    if wanted:
        absolute = {topic.lstrip("/"): topic for topic in topics}
        chosen = []
        for name in wanted:
            topic = absolute.get(name.lstrip("/"), "")
            if topic not in images:
                raise BagError(_no_such_topic(bag, name, images))
            chosen.append(topic)
    else:
        chosen = _default_images(bag, topics)
    inputs: dict[str, Input] = {}
    for topic in chosen:
        if topics[topic] == OBJECT_VIEW:
            inputs[topic] = Input("object_view", "")
            continue
        camera = _camera_of(topic)
        info = _camera_info_of(bag, topic, topics)
        inputs[topic] = Input("image" if topics[topic] == IMAGE else "compressed", camera)
        if info in inputs and inputs[info].camera != camera:
            text = (
                f"{inputs[info].camera} and {camera} share the camera info {info}, so they are two pictures "
                "of one camera; choose one of them."
            )
            raise BagError(text)
        inputs[info] = Input("camera_info", camera)
    for topic in _camera_poses_of(chosen, topics):
        inputs[topic] = Input("camera_pose", "")
    return inputs


def message_folder() -> Path:
    """The folder of this package's .msg files: installed with it, or beside it in a checkout.

    Raises:
        BagError: Neither is there.
    """
    here = Path(__file__).resolve()
    prefixes = [Path(each) for each in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if each]
    candidates = [
        here.parents[2] / "msg",
        *(prefix / "share/relpose_ros/msg" for prefix in (*here.parents, *prefixes, Path(sys.prefix))),
    ]
    for folder in candidates:
        if (folder / "ScanEstimate.msg").is_file():
            return folder
    raise BagError("The message definitions of relpose_ros are not installed; install the package again.")


@lru_cache(maxsize=1)
def _base_store() -> Typestore:
    """The types of ROS 2 Jazzy and this package's own."""
    store = get_typestore(Stores.ROS2_JAZZY)
    own: Typesdict = {}
    for file in sorted(message_folder().glob("*.msg")):
        own.update(get_types_from_msg(file.read_text(encoding="utf-8"), f"relpose_ros/msg/{file.stem}"))
    store.register(own)
    return store


def _salvage(source: Path, target: Path) -> int:
    """Copy every message before the damage of an MCAP file into a sound folder, and count them."""
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    connections: dict[tuple[str, str], Connection] = {}
    saved = 0
    with source.open("rb") as stream, Writer(target, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        records = StreamReader(stream, validate_crcs=True).records
        while True:
            try:
                record = next(records)
            except (
                Exception
            ):  # the damage (a cut record, a wrong checksum, data that does not unpack) or the end
                return saved
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Message):
                channel = channels[record.channel_id]
                name = schemas[channel.schema_id].name
                if (channel.topic, name) not in connections:
                    connections[channel.topic, name] = writer.add_connection(
                        channel.topic,
                        name,
                        msgdef=schemas[channel.schema_id].data.decode(),
                        rihs01=UNKNOWN_HASH,
                        serialization_format=channel.message_encoding,
                    )
                writer.write(connections[channel.topic, name], record.log_time, record.data)
                saved += 1


def _types_from_idl(text: str) -> Typesdict:
    """Types of an embedded IDL definition: one IDL text, or several under rosbag2's headlines."""
    ruler = "=" * 80 + "\n"
    if not text.startswith(f"{ruler}IDL: "):
        return get_types_from_idl(text)
    types: Typesdict = {}
    for part in text.split(ruler)[1:]:
        types.update(get_types_from_idl(part.partition("\n")[2]))
    return types


def _storage_suffix(path: Path) -> str | None:
    name = path.name.removesuffix(".zstd")
    return next((suffix for suffix in STORAGE_SUFFIXES if name.endswith(suffix)), None)


def _camera_of(image_topic: str) -> str:
    return image_topic.removesuffix("/compressed")


def _camera_info_of(bag: BagReader, image_topic: str, topics: dict[str, str]) -> str:
    beside = f"{_camera_of(image_topic).rpartition('/')[0]}/camera_info"
    if topics.get(beside) == CAMERA_INFO:
        return beside
    infos = [topic for topic, kind in topics.items() if kind == CAMERA_INFO]
    if len(infos) == 1:
        return infos[0]
    others = f", and of the others ({', '.join(infos)}) nobody knows whose they are" if infos else ""
    text = (
        f"{bag.path} has no camera info {beside} beside {image_topic}{others}: nothing says where the "
        "object's box is; record it too (its roi is the box, an empty one the whole image), or ObjectView."
    )
    raise BagError(text)


def _camera_poses_of(images: Sequence[str], topics: dict[str, str]) -> list[str]:
    poses = [
        topic for topic, kind in topics.items() if CAMERA_POSE_TOPICS.get(topic.rpartition("/")[2]) == kind
    ]
    places = {_camera_of(image).rpartition("/")[0] for image in images}
    beside = [topic for topic in poses if topic.rpartition("/")[0] in places]
    if beside:
        return beside
    return poses if len({topic.rpartition("/")[0] for topic in poses}) == 1 else []


def _default_images(bag: BagReader, topics: dict[str, str]) -> list[str]:
    if views := [topic for topic, kind in topics.items() if kind == OBJECT_VIEW]:
        return views
    per_camera: dict[str, str] = {}
    for topic, kind in topics.items():
        # image_transport's depth codec shares the message type, but its bytes are no picture.
        if kind in (IMAGE, COMPRESSED_IMAGE) and not topic.endswith("/compressedDepth"):
            camera = _camera_of(topic)
            if kind == IMAGE or camera not in per_camera:
                per_camera[camera] = topic
    if not per_camera:
        held = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(bag.topics.items()))
        text = (
            f"{bag.path} holds no images (ObjectView, Image or CompressedImage) to make views of. "
            f"It holds: {held}."
        )
        raise BagError(text)
    paired = [
        topic
        for camera, topic in per_camera.items()
        if topics.get(f"{camera.rpartition('/')[0]}/camera_info") == CAMERA_INFO
    ]
    chosen = paired or list(per_camera.values())
    if len(chosen) > 1:
        text = f"{bag.path} holds several cameras; choose with --topic: {', '.join(sorted(chosen))}."
        raise BagError(text)
    return chosen


def _no_such_topic(bag: BagReader, name: str, images: list[str]) -> str:
    held = f"It holds these: {', '.join(sorted(images))}." if images else "It holds no such topic at all."
    return f"{bag.path} has no topic {name} of type ObjectView, Image or CompressedImage. {held}"


def _reliable(*, latched: bool) -> Qos:
    return Qos(
        history=QosHistory.KEEP_LAST,
        depth=1 if latched else 10,
        reliability=QosReliability.RELIABLE,
        durability=QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
        # The largest time, which rosbag2 writes for "no deadline".
        deadline=QosTime(9223372036, 854775807),
        lifespan=QosTime(9223372036, 854775807),
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=QosTime(9223372036, 854775807),
        avoid_ros_namespace_conventions=False,
    )
