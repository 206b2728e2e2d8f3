"""Fits the confidence of a change on some patrols, and shows how well it is calibrated on others.

    python tests/benchmarks/confidence.py --fit FOLDER ... --test FOLDER ...

Each folder is a patrol left by patrols.py or paper.py (data/ and truth/). The detector runs with its gates nearly open,
so that it reports false objects too: hundreds to learn from where the default settings leave one or two. Every object
of every instance is labelled by the world's truth; a logistic regression on its evidence gives the weights that
daemon/confidence.py holds. Then, of the test patrols' objects, open gates and default settings: how many of those given
so much confidence are true.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from unittest import mock

import numpy as np
from rerun import copy_without_changes, detect_again
from scipy.optimize import minimize
from scipy.spatial import cKDTree
from scoring import OWN_M

from revisitd.daemon.confidence import WEIGHTS, confidence, features
from revisitd.daemon.config import Config
from revisitd.daemon.detection.results import DetectedObject
from revisitd.daemon.instances import ChangeDetection

OPEN_GATES = Config(
    detection={"min_points": 8, "min_showing_scans": 2, "min_showing_s": 0.3, "min_confirming_scans": 1}
)
RIDGE = 1.0
BINS = (0.0, 0.2, 0.4, 0.6, 0.8, 0.9, 0.95, 1.0001)


def objects_of(folder: Path, config: Config, min_share: float) -> list[tuple[DetectedObject, bool]]:
    """Every object that the instances of a patrol find, and whether it is a staged change."""
    staged = [
        (change["polarity"], cKDTree(np.array(change["points"]).reshape(-1, 3)))
        for change in json.loads((folder / "truth" / "changes.json").read_text())
    ]
    found: list[DetectedObject] = []
    record = ChangeDetection._record

    def collect(detection, comparison, instance):
        found.extend(comparison.detection.objects)
        return record(detection, comparison, instance)

    with tempfile.TemporaryDirectory() as work:
        copy_without_changes(folder / "data", Path(work) / "again")
        with (
            mock.patch.object(ChangeDetection, "_record", collect),
            mock.patch("revisitd.daemon.detection.detector.MIN_CONFIRMED_SHARE", min_share),
        ):
            detect_again(Path(work) / "again", config)
    return [(o, any(p == o.polarity and _is_of(o, tree) for p, tree in staged)) for o in found]


def _is_of(found: DetectedObject, surface: cKDTree) -> bool:
    return bool(np.isfinite(surface.query(found.points, distance_upper_bound=OWN_M)[0]).mean() >= 0.5)


def fit(objects: list[tuple[DetectedObject, bool]]) -> np.ndarray:
    """Weights of the features, the last one the constant."""
    x = np.array([features(o) for o, _ in objects])
    y = np.array([true for _, true in objects], float)

    def loss(weights):
        z = x @ weights
        return float((np.logaddexp(0.0, z) - y * z).sum() + 0.5 * RIDGE * (weights[:-1] ** 2).sum())

    return minimize(loss, np.zeros(x.shape[1]), method="BFGS").x


def reliability(name: str, objects: list[tuple[DetectedObject, bool]]) -> None:
    """Per bin of confidence: objects, mean confidence, share that is true."""
    given = np.array([confidence(o) for o, _ in objects])
    true = np.array([t for _, t in objects])
    print(f"{name}: {len(objects)} objects, {true.mean():.0%} true")
    for low, high in zip(BINS[:-1], BINS[1:], strict=True):
        inside = (given >= low) & (given < high)
        if inside.any():
            print(f"  {low:.2f}-{min(high, 1.0):.2f}: {inside.sum():4d} objects, mean {given[inside].mean():.2f}, "
                  f"true {true[inside].mean():.2f}")  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fit", type=Path, nargs="+", default=[])
    parser.add_argument("--test", type=Path, nargs="+", required=True)
    arguments = parser.parse_args()
    if arguments.fit:
        learnt = [o for folder in arguments.fit for o in objects_of(folder, OPEN_GATES, 0.05)]
        print(f"fitted on {len(learnt)} objects, {sum(t for _, t in learnt)} true")
        print("WEIGHTS =", tuple(round(float(w), 2) for w in fit(learnt)), " in daemon/confidence.py:", WEIGHTS)
    reliability("gates open", [o for folder in arguments.test for o in objects_of(folder, OPEN_GATES, 0.05)])
    reliability("default", [o for folder in arguments.test for o in objects_of(folder, Config(), 0.25)])


if __name__ == "__main__":
    main()
