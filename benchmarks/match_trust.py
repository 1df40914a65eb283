"""How far matches are to be trusted: the constants of `relpose_ros.inference.matches`, fitted on captures.

    python -m benchmarks.match_trust CAPTURE... [--boxes] [--descriptors [--weights FILE]]

Matches all pairs of each capture's photographs whose pose is known, with their masks where there are some.
With a network's descriptors it prints what `relpose_ros calibrate` keeps with its weights, of these captures.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from tqdm import tqdm

from relpose_ros.captures.folder import load_capture
from relpose_ros.evaluation.match_trust import MatchedPairs, fit_trust, observe_capture
from relpose_ros.inference.estimator import Estimator

FACTORS = (1.0, 2.0, 4.0, 8.0, 16.0)
FLOORS_DEG = (0.1, 0.2, 0.3, 0.5, 0.7)


def log_likelihood(pairs: MatchedPairs, factor: float, floor_deg: float, freedom: float = 4.0) -> float:
    """Mean over the right pairs of the log density of their error, Student's t, but for a constant."""
    covariances = factor * pairs.covariances + np.radians(floor_deg) ** 2 * np.eye(3)
    solved = np.linalg.solve(covariances, pairs.errors[..., None])[..., 0]
    squares = (pairs.errors * solved).sum(1)
    tails = -(freedom + 3) / 2 * np.log1p(squares / freedom)
    return float(np.mean(tails - np.linalg.slogdet(covariances).logabsdet / 2))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("captures", type=Path, nargs="*", help="capture folders with poses")
    parser.add_argument("--boxes", action="store_true", help="leave masks aside")
    parser.add_argument("--descriptors", action="store_true", help="a network's descriptors help")
    parser.add_argument("--weights", type=Path, help="whose (default: those that ship)")
    arguments = parser.parse_args()
    if not arguments.captures:
        print("Nothing to fit: name captures with poses.")
        return
    estimator = Estimator.from_weights(arguments.weights) if arguments.descriptors else None
    pairs = MatchedPairs.joined(
        [
            observe_capture(load_capture(each), estimator, masked=not arguments.boxes)
            for each in tqdm(arguments.captures)
        ]
    )
    found = fit_trust(pairs)
    if found is None:
        print(f"Too few pairs to fit: {len(pairs.right)} matched, {pairs.right.sum()} of them right.")
        return
    print(f"{len(pairs.right)} matched pairs, {pairs.right.mean():.0%} right")
    print("match_trust =" if arguments.descriptors else "TRUST =", tuple(np.round(found, 2).tolist()))
    print("log likelihood of the errors, by factor (down) and floor in degrees (across)")
    print(" " * 6 + "".join(f"{floor:8.1f}" for floor in FLOORS_DEG))
    for factor in FACTORS:
        print(f"{factor:6.0f}" + "".join(f"{log_likelihood(pairs, factor, f):8.2f}" for f in FLOORS_DEG))


if __name__ == "__main__":
    main()
