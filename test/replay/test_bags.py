from __future__ import annotations

import logging
import resource
import sqlite3
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from relpose_ros.replay.bags import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGE,
    OBJECT_VIEW,
    POSE_STAMPED,
    POSE_WITH_COVARIANCE_STAMPED,
    BagError,
    BagReader,
    BagWriter,
    choose_inputs,
    message_folder,
)

JAZZY = get_typestore(Stores.ROS2_JAZZY)
STRING = "std_msgs/msg/String"


def write_strings(
    path: Path,
    topics: dict[str, list[int]],
    plugin: StoragePlugin = StoragePlugin.MCAP,
    compression: CompressionMode = CompressionMode.NONE,
    size: int = 8,
) -> None:
    """A bag of strings that say topic and log time, logged at the given times."""
    writer = Writer(path, version=9, storage_plugin=plugin)
    writer.set_compression(compression, CompressionFormat.ZSTD)
    generator = np.random.default_rng(1)
    with writer:
        for topic, times in topics.items():
            connection = writer.add_connection(topic, STRING, typestore=JAZZY)
            for time in times:
                noise = generator.integers(97, 122, size).astype(np.uint8).tobytes().decode()
                message = JAZZY.types[STRING](data=f"{topic} {time} {noise}")
                writer.write(connection, time, JAZZY.serialize_cdr(message, STRING))


def read(path: Path, topics: list[str]) -> list[tuple[str, int]]:
    with BagReader(path) as bag:
        return [
            (record.topic, record.log_time_ns)
            for record in bag.records(topics)
            if record.message.data.startswith(f"{record.topic} {record.log_time_ns} ")
        ]


def only_file(folder: Path, suffix: str) -> Path:
    (file,) = folder.glob(f"*{suffix}")
    return file


TIMES = {"/a": [10, 30, 50], "/b": [20, 40], "/c": [25]}
IN_LOG_ORDER = [("/a", 10), ("/b", 20), ("/a", 30), ("/b", 40), ("/a", 50)]


@pytest.mark.parametrize("plugin", list(StoragePlugin))
@pytest.mark.parametrize("compression", [CompressionMode.NONE, CompressionMode.MESSAGE, CompressionMode.FILE])
@pytest.mark.parametrize("single", [False, True])
def test_every_kind_of_bag_is_read_in_log_order(
    tmp_path: Path, plugin: StoragePlugin, compression: CompressionMode, single: bool
) -> None:
    write_strings(tmp_path / "bag", TIMES, plugin, compression)
    suffix = {StoragePlugin.MCAP: ".mcap", StoragePlugin.SQLITE3: ".db3"}[plugin]
    if compression == CompressionMode.FILE:
        suffix += ".zstd"
    path = only_file(tmp_path / "bag", suffix) if single else tmp_path / "bag"
    assert read(path, ["/a", "/b"]) == IN_LOG_ORDER


def test_storage_compressed_mcap_is_read(tmp_path: Path) -> None:
    write_strings(tmp_path / "bag", TIMES, compression=CompressionMode.STORAGE)
    assert read(tmp_path / "bag", ["/a", "/b"]) == IN_LOG_ORDER


def test_files_of_a_recording_without_metadata_are_merged(tmp_path: Path) -> None:
    write_strings(tmp_path / "one", {"/a": [10, 30, 50]})
    write_strings(tmp_path / "two", {"/b": [20, 40]}, StoragePlugin.SQLITE3)
    (tmp_path / "bag").mkdir()
    only_file(tmp_path / "one", ".mcap").rename(tmp_path / "bag/bag_0.mcap")
    only_file(tmp_path / "two", ".db3").rename(tmp_path / "bag/bag_1.db3")
    assert read(tmp_path / "bag", ["/a", "/b"]) == IN_LOG_ORDER


@pytest.mark.parametrize("last", [b"", b"\x89MCAP0\r\n" + bytes(50)])
def test_a_recording_whose_last_file_came_to_nothing_is_read_without_it(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, last: bytes
) -> None:
    write_strings(tmp_path / "bag", TIMES)
    (tmp_path / "bag/metadata.yaml").unlink()
    (tmp_path / "bag/bag_1.mcap").write_bytes(last)
    assert read(tmp_path / "bag", ["/a", "/b"]) == IN_LOG_ORDER
    assert "bag_1.mcap" in caplog.text
    assert "It is left out." in caplog.text


@pytest.mark.parametrize("with_metadata", [False, True])
def test_a_cut_mcap_file_gives_what_came_before_the_cut(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, with_metadata: bool
) -> None:
    # Chunks are written out at a megabyte, and not in the order of time where topics take turns.
    times = {"/a": list(range(0, 4000, 2)), "/b": list(range(1, 4001, 2))}
    write_strings(tmp_path / "bag", times, size=1500)
    file = only_file(tmp_path / "bag", ".mcap")
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) * 7 // 10])
    if not with_metadata:
        (tmp_path / "bag/metadata.yaml").unlink()
    with caplog.at_level(logging.WARNING, "relpose_ros"):
        got = read(tmp_path / "bag", ["/a", "/b"])
    assert 0.5 * 4000 < len(got) < 0.75 * 4000
    assert [time for _, time in got] == sorted(time for _, time in got)
    assert "messages before the damage are used" in caplog.text


def test_a_file_damaged_inside_is_read_up_to_the_damage(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write_strings(tmp_path / "bag", {"/a": list(range(4000))}, compression=CompressionMode.STORAGE, size=1500)
    file = only_file(tmp_path / "bag", ".mcap")
    content = bytearray(file.read_bytes())
    content[len(content) // 2 : len(content) // 2 + 2000] = bytes(2000)
    file.write_bytes(content)
    with caplog.at_level(logging.WARNING, "relpose_ros"):
        got = read(tmp_path / "bag", ["/a"])
    assert [time for _, time in got] == list(range(len(got)))
    assert 1000 < len(got) < 2500
    assert f"is damaged after {len(got)} messages" in caplog.text


def test_what_does_not_match_its_checksum_is_not_saved(tmp_path: Path) -> None:
    """The end is lost, and before it a few letters were changed: the messages would still read."""
    file = tmp_path / "recorded.mcap"
    with file.open("wb") as stream:
        writer = McapWriter(stream, compression=CompressionType.NONE)  # with checksums, as ROS 2 records
        writer.start("ros2")
        schema = writer.register_schema(STRING, "ros2msg", b"string data")
        channel = writer.register_channel("/a", "cdr", schema)
        for time in range(3000):
            data = bytes(JAZZY.serialize_cdr(JAZZY.types[STRING](data=f"/a {time} {'x' * 1500}"), STRING))
            writer.add_message(channel, time, data, time)
        writer.finish()
    content = bytearray(file.read_bytes())
    del content[len(content) * 9 // 10 :]
    spoiled = content.index(b"/a 1500 ") + 100
    content[spoiled : spoiled + 20] = b"!" * 20
    file.write_bytes(content)
    with BagReader(file) as bag:
        messages = [record.message.data for record in bag.records(["/a"])]
    assert 500 < len(messages) <= 1500
    assert not any("!" in message for message in messages)


def test_a_damaged_database_is_refused(tmp_path: Path) -> None:
    write_strings(tmp_path / "bag", {"/a": list(range(500))}, StoragePlugin.SQLITE3, size=1500)
    file = only_file(tmp_path / "bag", ".db3")
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with pytest.raises(BagError, match="malformed"), BagReader(tmp_path / "bag"):
        pass


def test_a_message_that_is_not_what_its_type_says_is_left_out(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/a", STRING, typestore=JAZZY)
        writer.write(connection, 1, JAZZY.serialize_cdr(JAZZY.types[STRING](data="/a 1 "), STRING))
        writer.write(connection, 2, b"\x00\x01\x00\x00\xff\xff\xff\x7fabc")
        writer.write(connection, 3, b"\x28\xb5\x2f\xfd no message that zstd packed")
        writer.write(connection, 4, JAZZY.serialize_cdr(JAZZY.types[STRING](data="/a 4 "), STRING))
    with BagReader(tmp_path / "bag") as bag, caplog.at_level(logging.WARNING, "relpose_ros"):
        assert [record.log_time_ns for record in bag.records(["/a"])] == [1, 4]
        assert bag.unreadable == {"/a": 2}
    assert "logged at 2 ns is no std_msgs/msg/String" in caplog.text


def no_bag(tmp_path: Path, kind: str) -> Path:
    path = tmp_path / kind
    if kind == "folder":
        path.mkdir()
    elif kind == "no_messages":
        write_strings(path, {"/a": []})
    elif kind == "metadata_alone":
        write_strings(path, TIMES)
        only_file(path, ".mcap").unlink()
    elif kind == "tables.db3":
        sqlite3.connect(path).execute("CREATE TABLE x (y)").connection.close()
    elif kind in ("nothing.mcap", "nothing.db3"):
        path.touch()
    elif kind != "missing":
        path.write_bytes(b"\x89MCAP0\r\n" if kind == "magic.mcap" else b"this is no bag" * 100)
    return path


@pytest.mark.parametrize(
    ("kind", "sentence"),
    [
        ("missing", "does not exist"),
        ("folder", r"neither a \.mcap nor a \.db3"),
        ("metadata_alone", r"neither a \.mcap nor a \.db3"),
        ("photo.jpg", "is no bag"),
        ("old.bag", "ROS 1 bag"),
        ("nothing.mcap", "is empty"),
        ("nothing.db3", "is empty"),
        ("garbage.mcap", "cannot be read as a bag"),
        ("garbage.db3", "cannot be read as a bag"),
        ("garbage.mcap.zstd", "cannot be read as a bag|is empty"),
        ("magic.mcap", "no whole message is left"),
        ("tables.db3", "cannot be read as a bag"),
        ("no_messages", "without a message"),
    ],
)
def test_what_is_no_bag_is_told_in_a_sentence(tmp_path: Path, kind: str, sentence: str) -> None:
    path = no_bag(tmp_path, kind)
    with pytest.raises(BagError, match=sentence) as refusal, BagReader(path):
        pass
    assert str(refusal.value)[-1] in ".?"
    assert str(path) in str(refusal.value)


def write_older_object_view(path: Path) -> None:
    """A bag with an ObjectView of other fields than today's."""
    from rosbags.typesys import get_types_from_msg

    old = get_typestore(Stores.ROS2_JAZZY)
    old.register(get_types_from_msg("string object_id\nuint8 sharpness", OBJECT_VIEW))
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/object_view", OBJECT_VIEW, typestore=old)
        message = old.types[OBJECT_VIEW](object_id="mug", sharpness=7)
        writer.write(connection, 1, old.serialize_cdr(message, OBJECT_VIEW))


def test_the_bags_own_definition_of_a_type_is_believed(tmp_path: Path) -> None:
    """An older ObjectView with other fields is read by its own definition, not by today's."""
    write_older_object_view(tmp_path / "bag")
    with BagReader(tmp_path / "bag") as bag:
        (record,) = bag.records(["/object_view"])
    assert (record.message.object_id, record.message.sharpness) == ("mug", 7)


def test_the_bags_own_definition_goes_before_that_of_this_package(tmp_path: Path) -> None:
    """Also where the bag has none of another type."""
    write_older_object_view(tmp_path / "one")
    write_strings(tmp_path / "two", {"/a": [2]}, StoragePlugin.SQLITE3)
    drop_definitions(only_file(tmp_path / "two", ".db3"))
    (tmp_path / "bag").mkdir()
    only_file(tmp_path / "one", ".mcap").rename(tmp_path / "bag/bag_0.mcap")
    only_file(tmp_path / "two", ".db3").rename(tmp_path / "bag/bag_1.db3")
    with BagReader(tmp_path / "bag") as bag:
        first, second = bag.records(["/object_view", "/a"])
    assert (first.message.object_id, first.message.sharpness) == ("mug", 7)
    assert second.message.data.startswith("/a 2 ")


def drop_definitions(path: Path) -> None:
    """What bags of before Iron look like."""
    connection = sqlite3.connect(path)
    connection.execute("DELETE FROM message_definitions")
    connection.commit()
    connection.close()


def test_types_without_a_definition_are_those_of_this_package(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "new") as bag:
        types = bag.types
    typestore_message = object_view(types, "mug")
    from relpose_ros.replay import bags

    store = bags._base_store()
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connection = writer.add_connection("/object_view", OBJECT_VIEW, typestore=store)
        writer.write(connection, 1, store.serialize_cdr(typestore_message, OBJECT_VIEW))
    drop_definitions(only_file(tmp_path / "bag", ".db3"))
    with BagReader(tmp_path / "bag") as bag:
        (record,) = bag.records(["/object_view"])
    assert record.message.object_id == "mug"


def test_an_unknown_type_without_a_definition_is_named(tmp_path: Path) -> None:
    write_strings(tmp_path / "bag", TIMES, StoragePlugin.SQLITE3)
    file = only_file(tmp_path / "bag", ".db3")
    connection = sqlite3.connect(file)
    connection.execute("UPDATE topics SET type = 'acme_msgs/msg/Anvil'")
    connection.commit()
    connection.close()
    drop_definitions(file)
    with BagReader(file) as bag, pytest.raises(BagError, match="what a acme_msgs/msg/Anvil is"):
        list(bag.records(["/a"]))


def object_view(types: Any, object_id: str) -> Any:
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](1, 0), "camera")
    region = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    image = types[IMAGE](header, 0, 0, "", 0, 0, np.zeros(0, np.uint8))
    compressed = types[COMPRESSED_IMAGE](header, "", np.zeros(0, np.uint8))
    return types[OBJECT_VIEW](
        header=header, object_id=object_id, image=image, compressed=compressed, mask=image,
        box=region, crop=region, full_width=0, full_height=0, k=np.zeros(9),
    )  # fmt: skip


def test_what_is_written_carries_its_definitions(tmp_path: Path) -> None:
    for name in ("one", "two"):
        with BagWriter(tmp_path / name / "bag") as bag:
            bag.add_topic("/object_view", OBJECT_VIEW, latched=True)
            bag.write("/object_view", 5, object_view(bag.types, "mug"))
    with Reader(tmp_path / "one/bag") as reader:
        (connection,) = reader.connections
        assert "uint32 full_width" in connection.msgdef.data
        assert "MSG: sensor_msgs/RegionOfInterest" in connection.msgdef.data
        assert connection.ext.offered_qos_profiles[0].durability.name == "TRANSIENT_LOCAL"  # type: ignore[union-attr]
    for file in ("bag.mcap", "metadata.yaml"):
        assert (tmp_path / "one/bag" / file).read_bytes() == (tmp_path / "two/bag" / file).read_bytes()


def test_a_bag_is_not_written_over(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(BagError, match="cannot be created"), BagWriter(tmp_path / "file/bag"):
        pass
    with pytest.raises(BagError, match="exists already"):
        BagWriter(tmp_path)


def test_message_definitions_are_found() -> None:
    assert {file.stem for file in message_folder().glob("*.msg")} >= {"ObjectView", "ScanEstimate"}


class Topics(BagReader):
    """A bag of which only the list of topics matters."""

    def __init__(self, topics: dict[str, str]) -> None:
        super().__init__(Path("bag"))
        self.topics = topics
        self.counts.update(dict.fromkeys(topics, 3))


TWO_CAMERAS = {
    "/a/image": IMAGE,
    "/a/camera_info": CAMERA_INFO,
    "/b/image": IMAGE,
    "/b/camera_info": CAMERA_INFO,
}
Kind = Literal["object_view", "image", "compressed", "camera_info"]


@pytest.mark.parametrize(
    ("topics", "wanted", "inputs"),
    [
        (
            {"/camera/image": IMAGE, "/camera/camera_info": CAMERA_INFO, "/x": STRING},
            [],
            {
                "/camera/image": ("image", "/camera/image"),
                "/camera/camera_info": ("camera_info", "/camera/image"),
            },
        ),
        (
            {"/image": IMAGE, "/image/compressed": COMPRESSED_IMAGE, "/camera_info": CAMERA_INFO},
            [],
            {"/image": ("image", "/image"), "/camera_info": ("camera_info", "/image")},
        ),
        (
            {"/image": IMAGE, "/image/compressed": COMPRESSED_IMAGE, "/camera_info": CAMERA_INFO},
            ["image/compressed"],
            {"/image/compressed": ("compressed", "/image"), "/camera_info": ("camera_info", "/image")},
        ),
        (
            {"/image": IMAGE, "/image/compressed": COMPRESSED_IMAGE, "/camera_info": CAMERA_INFO},
            ["/image", "/image/compressed"],
            {
                "/image": ("image", "/image"),
                "/camera_info": ("camera_info", "/image"),
                "/image/compressed": ("compressed", "/image"),
            },
        ),
        (
            {"/views": OBJECT_VIEW, "/more_views": OBJECT_VIEW, "/image": IMAGE},
            [],
            {"/views": ("object_view", ""), "/more_views": ("object_view", "")},
        ),
        (
            {"/a/image": IMAGE, "/b/image": IMAGE, "/b/camera_info": CAMERA_INFO},
            [],
            {"/b/image": ("image", "/b/image"), "/b/camera_info": ("camera_info", "/b/image")},
        ),
        (
            TWO_CAMERAS,
            ["/a/image", "/b/image"],
            {
                "/a/image": ("image", "/a/image"),
                "/a/camera_info": ("camera_info", "/a/image"),
                "/b/image": ("image", "/b/image"),
                "/b/camera_info": ("camera_info", "/b/image"),
            },
        ),
        (
            {"/photos": COMPRESSED_IMAGE, "/info_from_elsewhere": CAMERA_INFO},
            [],
            {"/photos": ("compressed", "/photos"), "/info_from_elsewhere": ("camera_info", "/photos")},
        ),
        (
            {
                "/object_view": OBJECT_VIEW,
                "/camera_pose": POSE_STAMPED,
                "/camera_pose_with_covariance": POSE_WITH_COVARIANCE_STAMPED,
                "/ground_truth/pose": POSE_STAMPED,
            },
            [],
            {
                "/object_view": ("object_view", ""),
                "/camera_pose": ("camera_pose", ""),
                "/camera_pose_with_covariance": ("camera_pose", ""),
            },
        ),
        (
            {"/views": OBJECT_VIEW, "/arm/camera_pose": POSE_STAMPED, "/camera_pose": STRING},
            [],
            {"/views": ("object_view", ""), "/arm/camera_pose": ("camera_pose", "")},
        ),
        (
            {**TWO_CAMERAS, "/a/camera_pose": POSE_STAMPED, "/b/camera_pose": POSE_STAMPED},
            ["/b/image"],
            {
                "/b/image": ("image", "/b/image"),
                "/b/camera_info": ("camera_info", "/b/image"),
                "/b/camera_pose": ("camera_pose", ""),
            },
        ),
        (
            {"/views": OBJECT_VIEW, "/a/camera_pose": POSE_STAMPED, "/b/camera_pose": POSE_STAMPED},
            [],
            {"/views": ("object_view", "")},
        ),
    ],
)
def test_inputs_are_chosen_by_type_and_name(
    topics: dict[str, str], wanted: list[str], inputs: dict[str, tuple[Kind, str]]
) -> None:
    chosen = choose_inputs(Topics(topics), wanted)
    assert {topic: (each.kind, each.camera) for topic, each in chosen.items()} == inputs


@pytest.mark.parametrize(
    ("topics", "wanted", "sentence"),
    [
        ({"/x": STRING}, [], r"holds no images .* It holds: /x \(std_msgs/msg/String\)"),
        ({"/depth/compressedDepth": COMPRESSED_IMAGE}, [], "holds no images"),
        ({"/image": IMAGE}, [], "no camera info /camera_info beside /image"),
        (
            TWO_CAMERAS,
            [],
            "choose with --topic: /a/image, /b/image",
        ),
        ({"/image": IMAGE, "/camera_info": CAMERA_INFO}, ["/img"], "no topic /img .* these: /image"),
        ({"/x": STRING}, ["/x"], "no such topic at all"),
        (
            {"/image_raw": IMAGE, "/image_rect": IMAGE, "/camera_info": CAMERA_INFO},
            ["/image_raw", "/image_rect"],
            "two pictures of one camera",
        ),
    ],
)
def test_inputs_that_cannot_be_chosen_are_told(
    topics: dict[str, str], wanted: list[str], sentence: str
) -> None:
    with pytest.raises(BagError, match=sentence):
        choose_inputs(Topics(topics), wanted)


def test_topics_without_messages_are_no_choice() -> None:
    bag = Topics({"/a/image": IMAGE, "/b/image": IMAGE, "/camera_info": CAMERA_INFO})
    bag.counts["/a/image"] = 0
    assert set(choose_inputs(bag)) == {"/b/image", "/camera_info"}


@pytest.mark.parametrize("count", [1, 300])
def test_a_bag_for_which_there_is_no_room_is_told_and_removed(tmp_path: Path, count: int) -> None:
    """At the end, and on the way."""
    random = np.random.default_rng(0)

    def fill() -> None:
        with BagWriter(tmp_path / "bag") as bag:
            bag.add_topic("/a", STRING)
            for time in range(count):
                text = random.integers(97, 122, 20_000).astype(np.uint8).tobytes().decode()
                bag.write("/a", time, bag.types[STRING](data=text))

    allowed = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (8192, allowed[1]))
    try:
        with pytest.raises(BagError, match="bag cannot be written: File too large"):
            fill()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, allowed)
    assert not (tmp_path / "bag").exists()
