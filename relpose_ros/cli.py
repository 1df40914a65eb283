"""The command line: ``relpose_ros COMMAND``, from the node and the replay of bags to the training of weights.

Each command is a few lines into a function that a program could call as well. What a command needs is
imported when it runs, so that ``relpose_ros replay`` works without ROS and ``--help`` is quick.
"""

from __future__ import annotations

import argparse
import logging
import os
import sys
from collections import Counter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from relpose_ros.errors import RelPoseError
from relpose_ros.network.presets import PRESETS, VARIANTS
from relpose_ros.views import MAX_VIEWS, MIN_VIEWS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from relpose_ros.evaluation.protocol import PosedViews

    Run = Callable[[argparse.Namespace], int]

EXTRA_OF_MODULE = {
    "rclpy": "ros",
    "moderngl": "train",
    "trimesh": "train",
    "pycolmap": "evaluate",
}
"""Which extra brings a module that only some commands need."""
SPINS = "3000"
"""Turns, some microseconds, that PyTorch's threads wait for one another after each of an estimate's thousands
of small steps before they sleep. GNU OpenMP's own millions of turns are a tenth sooner on idle cores.
Where they have other work, as a robot's have, who waits takes the core of whom it waits for: an estimate of
0.3 s was seen to take 29 s, and 1.6 s with this."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code: 0, 1 with a sentence on stderr, or 130 after Ctrl-C."""
    arguments = _parser().parse_args(argv)
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", SPINS)  # read when PyTorch is imported, which is later
    run: Run = arguments.run
    try:
        return run(arguments)
    except RelPoseError as error:
        problem = str(error)
    except ModuleNotFoundError as error:
        extra = EXTRA_OF_MODULE.get((error.name or "").partition(".")[0])
        if extra is None:
            raise
        problem = (
            f"this command needs {error.name}, which is not installed: pip install 'relpose_ros[{extra}]'"
        )
    except KeyboardInterrupt:
        return 130
    print(f"relpose_ros {arguments.command}: {problem}", file=sys.stderr)
    return 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="relpose_ros",
        description="Camera poses, and how far to trust them, from 2 to 8 views of one object.",
    )
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)

    def command(name: str, run: Run, text: str) -> argparse.ArgumentParser:
        added = commands.add_parser(name, help=text, description=text)
        added.set_defaults(run=run)
        return added

    node = command("node", _node, "Run the ROS 2 node: images in, camera poses and their uncertainty out.")
    _add_weights(node)
    node.add_argument(
        "--ros-args", nargs=argparse.REMAINDER, default=[], help="all that follows goes to ROS as it is"
    )

    replay = command(
        "replay", _replay, "Run a recorded bag through the node's own code, and write a report to look at."
    )
    replay.add_argument("bag", type=Path, help="rosbag2 folder, or a single .mcap or .db3 file")
    replay.add_argument("--output", type=Path, required=True, metavar="DIR", help="where the results go")
    _add_topics(replay)
    replay.add_argument(
        "--config",
        type=Path,
        metavar="YAML",
        help="parameter file of the node, such as config/relpose_ros.yaml",
    )
    _add_weights(replay)

    pack = command("pack", _pack, "Turn a folder of photos with boxes (and poses, where known) into a bag.")
    pack.add_argument("capture", type=Path, help="capture folder: images/, cameras.json, perhaps masks/")
    pack.add_argument("--output", type=Path, required=True, metavar="BAG", help="rosbag2 folder to write")
    pack.add_argument(
        "--as",
        dest="form",
        choices=("image", "object_view"),
        default="image",
        help="standard messages with the box as region of interest (default), or this package's ObjectView",
    )

    pack.add_argument(
        "--object-id",
        default="",
        metavar="ID",
        help="of the object, for ObjectView, which alone carries it (default: the folder's name)",
    )
    pack.add_argument(
        "--period", type=float, default=1.0, metavar="S", help="seconds between two photos (default: 1)"
    )

    evaluate = command(
        "evaluate",
        _evaluate,
        "Measure poses on captures that have them, by the paper's protocol, beside baselines.",
    )
    _add_captures(evaluate)
    evaluate.add_argument(
        "--views",
        type=_view_counts,
        default=_view_counts("2..8"),
        metavar="N|N..M",
        help="numbers of views (default: 2..8)",
    )
    evaluate.add_argument(
        "--method",
        action="append",
        metavar="NAME",
        help="relpose (as it ships), relpose-known (its known cameras alone), both (network and matches, not "
        "refined), learned (the network alone), geometry (SIFT's matches alone), constant-translation, "
        "identity or pycolmap; again for more (default: all)",
    )
    evaluate.add_argument(
        "--variant",
        action="append",
        type=_home_path,
        default=[],
        metavar="FILE",
        help="weights of a variant (train --variant), measured beside the methods in rows that bear its "
        "name, such as regression; again for more",
    )
    evaluate.add_argument(
        "--orders",
        type=_at_least(1),
        default=5,
        metavar="K",
        help="random orders of each capture's views (default: 5, the paper's)",
    )
    evaluate.add_argument("--seed", type=_at_least(0), default=0, help="seed of those orders (default: 0)")
    evaluate.add_argument("--output", type=Path, metavar="FILE", help="JSON file for the rows")
    _add_weights(evaluate)

    calibrate = command(
        "calibrate",
        _calibrate,
        "Fit how far a network's probabilities hold on captures it was not trained on, and store it with the "
        "weights.",
    )
    calibrate.add_argument(
        "weights",
        type=_home_path,
        metavar="WEIGHTS",
        help="network weights to calibrate: safetensors or a released checkpoint",
    )
    _add_captures(calibrate)
    calibrate.add_argument(
        "--output", type=_home_path, required=True, metavar="FILE", help="safetensors file to write"
    )
    calibrate.add_argument(
        "--scans",
        type=int,
        metavar="K",
        help="scans to fit on, and as many to measure on, of all that a path holds (default: 24)",
    )
    calibrate.add_argument("--seed", type=_at_least(0), default=0, help="of the scans (default: 0)")
    calibrate.add_argument("--half", action="store_true", help="write the weights in float16, half as large")

    render = command(
        "render",
        _render,
        "Render synthetic scans with exact poses: captures, training shards or the demo bags.",
    )
    render.add_argument("output", type=Path, metavar="DIR", help="folder to write into")
    render.add_argument(
        "--as",
        dest="form",
        choices=("captures", "shards", "demo-bags"),
        default="captures",
        help="captures of whole photographs (default), shards of crops for the trainer, or the bags of bags/",
    )
    render.add_argument(
        "--count", type=_at_least(1), default=1, metavar="K", help="captures or shards (default: 1)"
    )
    render.add_argument(
        "--views", type=_at_least(2), default=10, metavar="N", help="views of each scan (default: 10)"
    )
    render.add_argument(
        "--seed", type=_at_least(0), default=0, help="names the endless list of scans (default: 0)"
    )
    render.add_argument(
        "--assets",
        type=Path,
        metavar="DIR",
        help="folder with meshes/ and backgrounds/ (default: procedural alone)",
    )
    render.add_argument(
        "--split", choices=("train", "held_out"), default="train", help="which meshes (default: train)"
    )
    render.add_argument(
        "--size",
        type=_at_least(1),
        default=128,
        metavar="PX",
        help="side of the crops of a shard (default: 128)",
    )
    render.add_argument(
        "--processes",
        type=_at_least(1),
        default=1,
        metavar="K",
        help="processes that render shards (default: 1)",
    )

    shard = command(
        "shard", _shard, "Cut photos of captures with poses into shards of crops for the trainer."
    )
    shard.add_argument(
        "capture",
        type=Path,
        nargs="+",
        help="capture folder, or a folder of such; category of CO3Dv2, or the folder of all categories",
    )
    shard.add_argument("--output", type=Path, required=True, metavar="DIR", help="folder to write into")
    shard.add_argument(
        "--preset", choices=sorted(PRESETS), default="compact", help="for which network (default: compact)"
    )
    shard.add_argument(
        "--copies",
        type=_at_least(1),
        default=1,
        metavar="K",
        help="crops of each photo, each with a jitter of its own (default: 1)",
    )
    shard.add_argument(
        "--masked-copies",
        type=_at_least(0),
        default=0,
        metavar="K",
        help="how many of them show the object alone, where there are masks (default: 0)",
    )
    _add_split(shard, "train")
    shard.add_argument("--seed", type=_at_least(0), default=0, help="of the jitter (default: 0)")

    features = command(
        "features",
        _features,
        "Keep what the frozen backbone of 'compact' sees in shards, so that it is trained many times sooner.",
    )
    features.add_argument("shards", type=Path, nargs="+", metavar="SHARDS", help="folders of shards of crops")
    features.add_argument("--output", type=Path, required=True, metavar="DIR", help="folder to write into")
    features.add_argument(
        "--copies",
        type=_at_least(1),
        default=1,
        metavar="K",
        help="how often each scan is looked at, changed at random (default: 1)",
    )
    features.add_argument(
        "--plain", action="store_true", help="look at the scans as they are, for instance to measure on"
    )
    features.add_argument("--seed", type=_at_least(0), default=0, help="of the changes (default: 0)")

    train = command(
        "train", _train, "Train a network on rendered shards, or go on with a run that was stopped."
    )
    train.add_argument(
        "run_folder", type=Path, metavar="RUN", help="folder of the run: curve, checkpoint, weights"
    )
    train.add_argument(
        "--scans", type=Path, nargs="+", required=True, metavar="DIR", help="folders of shards to learn from"
    )
    train.add_argument(
        "--held-out",
        type=Path,
        nargs="+",
        metavar="DIR",
        help="folders of shards of other objects, to measure on",
    )
    train.add_argument(
        "--preset", choices=sorted(PRESETS), default="compact", help="which network (default: compact)"
    )
    train.add_argument(
        "--variant",
        action="append",
        choices=sorted(VARIANTS),
        default=[],
        help="ablation of the paper to train instead; again for several at once",
    )
    train.add_argument(
        "--images",
        type=_at_least(1),
        metavar="K",
        help="images to see in the whole run (default: the preset's)",
    )
    train.add_argument(
        "--budget", type=float, metavar="SECONDS", help="stop after so long; the same command goes on"
    )
    train.add_argument(
        "--device",
        default="cpu",
        help="cpu (default), cuda, cuda:1 ... Several processes: start with torchrun",
    )
    train.add_argument(
        "--precision",
        choices=("float32", "bfloat16", "float16"),
        help="of the forward pass, energies aside (default: bfloat16 for paper, float32 for compact)",
    )
    train.add_argument(
        "--workers",
        type=_at_least(0),
        default=0,
        metavar="K",
        help="processes beside it that prepare batches (default: 0)",
    )
    train.add_argument(
        "--backbone-rate",
        type=float,
        default=0.0,
        metavar="SHARE",
        help="train the pretrained backbone of 'compact' too, behind the first features that are kept of it, "
        "at this share of the learning rate (default: 0, it stays as it is)",
    )
    train.add_argument(
        "--start-from",
        type=_home_path,
        metavar="FILE",
        help="weights of the same network to begin with; the images they have seen count towards --images",
    )
    train.add_argument(
        "--compile",
        action="store_true",
        dest="compiled",
        help="compile the step first: minutes, for about half as many images again a second",
    )
    train.add_argument("--seed", type=_at_least(0), default=0, help="of the run (default: 0)")

    convert = command(
        "convert", _convert, "Turn a released RelPose++ checkpoint into safetensors with its origin inside."
    )
    convert.add_argument(
        "source", type=Path, help="checkpoint of the authors' release (.pth), or a safetensors file"
    )
    convert.add_argument(
        "--output", type=_home_path, required=True, metavar="FILE", help="safetensors file to write"
    )
    return parser


def _add_weights(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--weights",
        type=_home_path,
        metavar="FILE",
        help="network weights: safetensors or a released checkpoint (default: the compact ones that ship)",
    )


def _add_captures(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "capture",
        type=Path,
        nargs="+",
        help="capture folder with camera poses, or a folder of such; bag with a topic ground_truth/pose; "
        "category of CO3Dv2, or the folder of all categories",
    )
    parser.add_argument(
        "--no-masks", action="store_true", help="give the boxes alone, as where nobody segmented the object"
    )
    _add_split(parser, "held_out")
    _add_topics(parser)


def _add_split(parser: argparse.ArgumentParser, default: str) -> None:
    parser.add_argument(
        "--split",
        choices=("held_out", "train"),
        default=default,
        help="which categories of CO3Dv2, where a folder holds them all: the paper's ten that training does "
        f"not see, or the others (default: {default})",
    )


def _add_topics(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--topic",
        action="append",
        default=[],
        metavar="NAME",
        help="topic of images or ObjectView in a bag; again for more (default: all ObjectView topics, else "
        "the images of the camera, where there is but one)",
    )


def _at_least(least: int) -> Callable[[str], int]:
    """An argument's type: a whole number, not below another."""

    def number(text: str) -> int:
        if (value := int(text)) < least:
            raise argparse.ArgumentTypeError(f"{value} is below {least}, the least")
        return value

    number.__name__ = "whole number"  # as argparse calls it where the text is none
    return number


def _home_path(text: str) -> Path:
    """A path that may begin with ~, which shells leave alone in ``--weights=~/file``."""
    try:
        return Path(text).expanduser()
    except RuntimeError as err:
        raise argparse.ArgumentTypeError(
            f"{text!r} begins with the home folder of a user who does not exist"
        ) from err


def _view_counts(text: str) -> tuple[int, ...]:
    """``5`` or ``2..8``, as numbers."""
    first, dots, last = text.partition("..")
    try:
        counts = tuple(range(int(first), int(last if dots else first) + 1))
    except ValueError:
        counts = ()
    if not counts or counts[0] < MIN_VIEWS or counts[-1] > MAX_VIEWS:
        text = f"{text!r} are no numbers of views from {MIN_VIEWS} to {MAX_VIEWS}: write 5, or 2..8"
        raise argparse.ArgumentTypeError(text)
    return counts


def _node(arguments: argparse.Namespace) -> int:
    from relpose_ros.node.scan_node import run_node

    weights = arguments.weights
    # Quoted as YAML, which is how ROS reads a parameter: a file may be named 12.
    quoted = str(weights).replace("'", "''")
    given = [] if weights is None else ["--ros-args", "-p", f"weights:='{quoted}'", "--"]
    return run_node([*given, "--ros-args", *arguments.ros_args])


def _replay(arguments: argparse.Namespace) -> int:
    from relpose_ros.replay.replay import replay
    from relpose_ros.scanning.settings import ScanSettings

    settings = ScanSettings.from_yaml(arguments.config) if arguments.config else None
    replay(
        arguments.bag,
        arguments.output,
        topics=arguments.topic,
        settings=settings,
        weights=arguments.weights,
    )
    return 0


def _pack(arguments: argparse.Namespace) -> int:
    from relpose_ros.replay.pack import pack

    pack(
        arguments.capture,
        arguments.output,
        form=arguments.form,
        object_id=arguments.object_id,
        period_s=arguments.period,
    )
    return 0


def _evaluate(arguments: argparse.Namespace) -> int:
    from relpose_ros.evaluation.protocol import evaluate, table, trust_table

    rows = evaluate(
        _distinct([(path, each) for path in arguments.capture for each in _posed_views(path, arguments)]),
        arguments.views,
        arguments.weights,
        arguments.method,
        arguments.output,
        arguments.seed,
        variants=arguments.variant,
        orders=arguments.orders,
    )
    print(table(rows))
    if told := trust_table(rows):
        print(f"\nWhat estimates said of their own errors, over all captures:\n\n{told}")
    return 0


def _calibrate(arguments: argparse.Namespace) -> int:
    from relpose_ros.evaluation.calibrate import SCANS, calibrate, calibration_table, trust_line

    found = calibrate(
        {str(path): list(_posed_views(path, arguments)) for path in arguments.capture},
        arguments.weights,
        arguments.output,
        scans=SCANS if arguments.scans is None else arguments.scans,
        seed=arguments.seed,
        half=arguments.half,
    )
    print(f"{found.calibration.to_json()}\n\nOn other scans, uncalibrated -> calibrated:\n")
    print(f"{calibration_table(found.reports)}\n\n{trust_line(found.trust)}")
    return 0


def _posed_views(path: Path, arguments: argparse.Namespace) -> Iterator[PosedViews]:
    """What is measured on at a place: of a bag each object, else each capture."""
    from relpose_ros.captures.opening import open_captures
    from relpose_ros.evaluation.protocol import PosedViews, posed_views
    from relpose_ros.replay.bags import is_bag
    from relpose_ros.replay.ground_truth import read_posed_views

    masked = not arguments.no_masks
    if not is_bag(path):
        for capture in open_captures(path, arguments.split):
            yield posed_views(capture, masked=masked)
        return
    objects = read_posed_views(path, arguments.topic)
    for object_id, known in objects.items():
        name = path.stem if len(objects) == 1 else f"{path.stem}/{object_id}"
        views, poses = [each.view for each in known], [each.camera_from_world for each in known]
        yield PosedViews.of_views(name, views, poses, masked=masked)


def _distinct(found: Sequence[tuple[Path, PosedViews]]) -> list[PosedViews]:
    """What was found at some places. Where two bear one name, tables tell their places too."""
    from dataclasses import replace

    names = Counter(each.name for _, each in found)
    return [each if names[each.name] == 1 else replace(each, place=str(path)) for path, each in found]


def _render(arguments: argparse.Namespace) -> int:
    if arguments.form == "demo-bags":
        return _render_demo_bags(arguments.output)
    if arguments.form == "shards":
        from relpose_ros.captures.shards import ShardPlan, write_shards

        plan = ShardPlan(
            seed=arguments.seed,
            views=arguments.views,
            image_size=arguments.size,
            assets=arguments.assets,
            split=arguments.split,
        )
        write_shards(arguments.output, arguments.count, plan, processes=arguments.processes)
        return 0
    from tqdm import tqdm

    from relpose_ros.captures.assets import load_assets
    from relpose_ros.captures.rendered import render_capture

    assets = load_assets(arguments.assets, arguments.split) if arguments.assets else None
    for index in tqdm(range(arguments.count), unit="capture"):
        folder = arguments.output / f"{arguments.seed}_{index:05d}"
        render_capture(folder, arguments.seed, index, arguments.views, assets=assets)
    return 0


def _render_demo_bags(output: Path) -> int:
    from relpose_ros.captures.demo import render_demo_captures
    from relpose_ros.replay.pack import pack

    with TemporaryDirectory() as folder:
        for demo in render_demo_captures(Path(folder)):
            name, period_s = demo.name, demo.period_s
            pack(Path(folder, name), output / name, form=demo.form, object_id=name, period_s=period_s)
    return 0


def _shard(arguments: argparse.Namespace) -> int:
    from relpose_ros.captures.opening import open_captures
    from relpose_ros.training.photographs import write_capture_shards

    write_capture_shards(
        arguments.output,
        (capture for path in arguments.capture for capture in open_captures(path, arguments.split)),
        PRESETS[arguments.preset],
        arguments.copies,
        masked_copies=arguments.masked_copies,
        seed=arguments.seed,
    )
    return 0


def _features(arguments: argparse.Namespace) -> int:
    from relpose_ros.training.batches import Augmentation
    from relpose_ros.training.feature_shards import write_feature_shards
    from relpose_ros.training.settings import initial_network, settings_for

    write_feature_shards(
        arguments.output,
        arguments.shards,
        initial_network(settings_for("compact")).eval(),
        arguments.copies,
        augmentation=None if arguments.plain else Augmentation(),
        seed=arguments.seed,
    )
    return 0


def _train(arguments: argparse.Namespace) -> int:
    from dataclasses import replace

    from relpose_ros.training.batches import open_scans
    from relpose_ros.training.settings import settings_for
    from relpose_ros.training.trainer import Trainer

    settings = replace(settings_for(arguments.preset, arguments.variant), seed=arguments.seed)
    if arguments.images is not None:
        settings = replace(settings, images=arguments.images)
    if arguments.precision:
        settings = replace(settings, precision=arguments.precision)
    settings = replace(settings, backbone_rate=arguments.backbone_rate)
    held_out = open_scans(arguments.held_out) if arguments.held_out else None
    scans = open_scans(arguments.scans)
    trainer = Trainer(
        settings,
        arguments.run_folder,
        scans,
        held_out,
        device=arguments.device,
        workers=arguments.workers,
        start_from=arguments.start_from,
        compiled=arguments.compiled,
    )
    trainer.run(arguments.budget)
    return 0


def _convert(arguments: argparse.Namespace) -> int:
    from relpose_ros.network.checkpoint import convert

    convert(arguments.source, arguments.output)
    return 0
