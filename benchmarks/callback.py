"""How long a full-HD picture holds up the node's callbacks, in milliseconds and in copies of the frame.

    python -m benchmarks.callback [--repeats 50]

Side by side in one run: what rclpy spends on reading a message, and what the node's callback adds, which
decodes the box's surroundings and stores the view. Estimates are not part of it: another thread makes them.
"""

from __future__ import annotations

import argparse
import statistics
import time
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from builtin_interfaces.msg import Time
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, RegionOfInterest
from std_msgs.msg import Header
from tqdm import tqdm

from relpose_ros.scanning.scanner import Scanner
from relpose_ros.scanning.settings import ScanSettings

if TYPE_CHECKING:
    from relpose_ros.scanning.scanner import Kind

WIDTH, HEIGHT = 1920, 1080
BOXES = {"whole frame": (0, 0, 0, 0), "640 x 640": (640, 220, 640, 640)}
"""x, y, width and height of the roi; zeros are the full image."""
BYTES_A_PIXEL = {"rgb8": 3, "bgr8": 3, "mono8": 1, "bayer_rggb8": 1, "uyvy": 2}


class NoEstimator:
    """Never asked: the callbacks only collect views."""

    def estimate(self, _: Any) -> Any:
        raise AssertionError


def header(stamp_s: int) -> Header:
    return Header(stamp=Time(sec=stamp_s), frame_id="camera")


def picture(encoding: str, noise: np.ndarray) -> Image | CompressedImage:
    if encoding == "jpeg":
        smooth = cv2.GaussianBlur(noise, (0, 0), 4.0)  # compresses about as a photo does
        compressed = CompressedImage(format="jpeg")
        compressed.data.frombytes(cv2.imencode(".jpg", smooth)[1].tobytes())
        return compressed
    channels = BYTES_A_PIXEL[encoding]
    raw = Image(width=WIDTH, height=HEIGHT, encoding=encoding, step=channels * WIDTH)
    raw.data.frombytes(noise[:, :, :channels].tobytes())
    return raw


def milliseconds(encoding: str, roi: tuple[int, ...], noise: np.ndarray, repeats: int) -> list[list[float]]:
    """Of copying the frame, of reading the message, and of the callback; after a message to warm up."""
    scanner = Scanner(NoEstimator(), ScanSettings(keep="latest"))
    sent = picture(encoding, noise)
    kind: Kind = "compressed" if encoding == "jpeg" else "image"
    x, y, width, height = roi
    box = RegionOfInterest(x_offset=x, y_offset=y, width=width, height=height)
    spent: list[list[float]] = [[], [], []]
    for stamp in range(1, repeats + 2):
        info = CameraInfo(header=header(stamp), width=WIDTH, height=HEIGHT, roi=box)
        scanner.receive("camera_info", "camera_info", info)
        sent.header = header(stamp)
        serialised = serialize_message(sent)
        times = [time.perf_counter()]
        noise.copy()
        times.append(time.perf_counter())
        message = deserialize_message(serialised, type(sent))
        times.append(time.perf_counter())
        receipt = scanner.receive(kind, "image", message)
        times.append(time.perf_counter())
        assert receipt.accepted, receipt.reason
        for column, seconds in zip(spent, np.diff(times), strict=True):
            column.append(1e3 * seconds)
    return [column[1:] for column in spent]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=50)
    repeats = parser.parse_args().repeats
    noise = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    print(f"{WIDTH} x {HEIGHT}, median ms (over one copy of an rgb8 frame; slowest ms), {repeats} pictures")
    print(f"{'encoding':12} {'box':12} {'reading the message':>28} {'callback':>28}")
    cases = [(encoding, box) for encoding in (*BYTES_A_PIXEL, "jpeg") for box in BOXES]
    for encoding, box in tqdm(cases, leave=False, disable=None):
        copying, *columns = milliseconds(encoding, BOXES[box], noise, repeats)
        unit = statistics.median(copying)
        cells = [
            f"{statistics.median(each):8.2f} ({statistics.median(each) / unit:5.1f}x; {max(each):6.2f})"
            for each in columns
        ]
        tqdm.write(f"{encoding:12} {box:12} {cells[0]:>28} {cells[1]:>28}")


if __name__ == "__main__":
    main()
