"""How the scan descriptor behaves on real captures, where nobody knows the overlap: its distance against the way.

    python tests/benchmarks/descriptor_real.py drive.pcap os1.pcap --meta os1.json

For each capture, from all pairs of its scans: the mean distance by how far the sensor moved between them (by KISS-ICP),
and how well the two agree in rank. For several captures, the smallest distance between scans of two of them as well.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from scipy.stats import spearmanr

from revisitd.daemon.config import Config
from revisitd.daemon.odometry import Odometry
from revisitd.drivers.ouster import open_source
from revisitd.models.descriptor import DescriptorModel
from revisitd.models.metrics import descriptor_distances, pairs

EDGES_M = np.array([0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0])


def descriptors_and_positions(
    capture: Path, meta: Path | None, model: DescriptorModel
) -> tuple[np.ndarray, np.ndarray]:
    """(N, 256) float32, and (N, 3) metres of the sensor at the end of each scan."""
    odometry, descriptors, positions = Odometry(Config().odometry), [], []
    with open_source(str(capture), meta) as frames:
        for frame in frames:
            sensor = frame.sensor
            descriptors.append(model.describe(frame.range_mm, sensor.pixel_shift, sensor.altitude_rad))
            positions.append(odometry.register(frame).T_odom_sensor[:3, 3])
    return np.array(descriptors), np.array(positions)


def table(descriptors: np.ndarray, positions: np.ndarray, model: DescriptorModel) -> str:
    """Distance by way, and the overlap that it means on virtual worlds."""
    distance = pairs(descriptor_distances(descriptors))
    way_m = pairs(np.linalg.norm(positions[:, None] - positions, axis=2))
    lines = [f"{'way (m)':>12}{'pairs':>8}{'distance':>10}{'overlap expected':>18}"]
    for low, high in zip(EDGES_M, EDGES_M[1:], strict=False):
        inside = distance[(way_m >= low) & (way_m < high)]
        if inside.size:
            expected = model.overlap_from_distance(inside).mean()
            lines.append(f"{low:6g} -{high:4g}{inside.size:8d}{inside.mean():10.3f}{expected:18.2f}")
    if len(distance) > 2:
        lines.append(f"Spearman of distance and way: {spearmanr(distance, way_m).statistic:.3f}")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", type=Path, nargs="+")
    parser.add_argument("--meta", type=Path, help="the metadata of captures that have none beside them")
    arguments = parser.parse_args()
    model, seen = DescriptorModel.load(), []
    for capture in arguments.captures:
        beside = capture.with_suffix(".json").exists()
        descriptors, positions = descriptors_and_positions(capture, None if beside else arguments.meta, model)
        print(f"{capture.name}: {len(descriptors)} scans, model {model.model_id}")
        print(table(descriptors, positions, model), end="\n\n")
        seen.append(descriptors)
    across = [descriptor_distances(one, other).min() for i, one in enumerate(seen) for other in seen[:i]]
    if across:
        print(f"scans of two captures are {min(across):.3f} apart at least")


if __name__ == "__main__":
    main()
