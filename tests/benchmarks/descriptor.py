"""Figures of the scan descriptor on held-out virtual worlds, beside two baselines on the same pairs.

    python tests/benchmarks/descriptor.py --plot distance_overlap.png

Needs the [sim] extra. Baselines: Scan Context (polar grid of heights, best rotation) and the true distance
between the two positions, which no descriptor knows.
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from revisitd.models.descriptor import DescriptorModel
from revisitd.models.metrics import descriptor_distances, pairs, rank_agreement, recall
from revisitd.models.preprocess import N_COLUMNS
from revisitd.models.scan_sets import FIRST_SEED, SCANS_PER_WORLD, WorldScans, along_route, anywhere, scan_world

NEAR_M = 25.0
PLACE_M = 3.0
LOST_SHARE = 0.1
COLUMNS_PER_PACKET = 16
RINGS, SECTORS, REACH_M = 20, 60, 60.0


class Measured:
    """The scans of all worlds, their truth, and pairwise distances by several methods."""

    def __init__(self, worlds: list[WorldScans], model: DescriptorModel):
        self.worlds, self.model = worlds, model
        self.overlap = np.concatenate([pairs(world.overlaps().astype(float)) for world in worlds])
        self.apart_m = np.concatenate([pairs(world.distances_m()) for world in worlds])
        self.descriptors = [describe(model, world) for world in worlds]
        self.distance = np.concatenate([pairs(descriptor_distances(some)) for some in self.descriptors])
        self.contexts = [scan_contexts(world) for world in worlds]
        self.context_distance = np.concatenate([pairs(context_distances(some, some)) for some in self.contexts])

    def recalls(self, distances: np.ndarray, k: int) -> float:
        """Of the scans of later seasons, looked up among those of the first season of every world."""
        query = np.concatenate([world.season > 0 for world in self.worlds])
        return recall(distances[query][:, ~query], self._same_place()[query][:, ~query], k)[0]

    def n_queries(self) -> int:
        query = np.concatenate([world.season > 0 for world in self.worlds])
        return int(self._same_place()[query][:, ~query].any(axis=1).sum())

    def _same_place(self) -> np.ndarray:
        sizes = np.cumsum([0] + [len(world.season) for world in self.worlds])
        same = np.zeros((sizes[-1], sizes[-1]), bool)
        for world, start, end in zip(self.worlds, sizes[:-1], sizes[1:], strict=True):
            same[start:end, start:end] = world.distances_m() <= PLACE_M
        return same


def describe(model: DescriptorModel, world: WorldScans) -> np.ndarray:
    """(N, 256) float32."""
    return np.stack([model.describe(image, world.pixel_shift, world.altitude_rad) for image in world.range_mm])


def with_lost_packets(world: WorldScans, rng: np.random.Generator) -> WorldScans:
    """The same scans with a tenth of their packets lost."""
    n, _, width = world.range_mm.shape
    lost = rng.random((n, width // COLUMNS_PER_PACKET)) < LOST_SHARE
    keep = ~np.repeat(lost, COLUMNS_PER_PACKET, axis=1)
    return replace(world, range_mm=world.range_mm * keep[:, None, :])


def scan_contexts(world: WorldScans) -> np.ndarray:
    """(N, RINGS, SECTORS): largest height in each cell of a polar grid, each sector scaled to unit length."""
    grids = np.zeros((len(world.range_mm), RINGS, SECTORS))
    for grid, view in zip(grids, world.views(), strict=True):
        x, y, z = view.points().T
        ring = (np.hypot(x, y) * (RINGS / REACH_M)).astype(int)
        sector = ((np.arctan2(y, x) + np.pi) * (SECTORS / (2 * np.pi))).astype(int) % SECTORS
        inside = ring < RINGS
        np.maximum.at(grid, (ring[inside], sector[inside]), z[inside] + 3.0)
    return grids / np.maximum(np.linalg.norm(grids, axis=1, keepdims=True), 1e-9)


def context_distances(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """(N, M): one minus the mean cosine of the sectors at the best of all rotations."""
    a, b = np.fft.rfft(one, axis=2), np.fft.rfft(other, axis=2)
    distances = [
        1.0 - np.fft.irfft((row.conj()[None] * b).sum(axis=1), SECTORS, axis=1).max(axis=1) / SECTORS for row in a
    ]
    return np.stack(distances)


def yaw_change(model: DescriptorModel, world: WorldScans, columns: int) -> float:
    """Largest distance between a scan and itself turned by some sensor columns."""
    turned = replace(world, range_mm=np.roll(world.range_mm, columns, axis=2))
    return float(np.linalg.norm(describe(model, world) - describe(model, turned), axis=1).max())


def milliseconds_per_scan(model: DescriptorModel, world: WorldScans) -> float:
    """Median over the scans, preprocessing included."""
    times = []
    for image in world.range_mm:
        begun = time.perf_counter()
        model.describe(image, world.pixel_shift, world.altitude_rad)
        times.append(time.perf_counter() - begun)
    return 1e3 * float(np.median(times))


def table(measured: Measured) -> str:
    """The figures beside the baselines'."""
    near = measured.apart_m <= NEAR_M
    everywhere = np.concatenate(measured.descriptors)
    contexts = np.concatenate(measured.contexts)
    to_all, context_to_all = descriptor_distances(everywhere), context_distances(contexts, contexts)
    ranks = [
        [
            rank_agreement(d[part], measured.overlap[part])
            for d in (measured.distance, measured.context_distance, measured.apart_m)
        ]
        for part in (near | True, near)
    ]
    rows = [
        f"{'':34}{'descriptor':>12}{'Scan Context':>14}{'position':>10}",
        f"{'Spearman, all pairs':34}" + "{:12.3f}{:14.3f}{:10.3f}".format(*ranks[0]),
        f"{f'Spearman, pairs within {NEAR_M:.0f} m':34}" + "{:12.3f}{:14.3f}{:10.3f}".format(*ranks[1]),
    ]
    for k in (1, 5):
        rows.append(
            f"{f'recall@{k} at {PLACE_M:.0f} m, any yaw':34}{measured.recalls(to_all, k):12.3f}"
            f"{measured.recalls(context_to_all, k):14.3f}{'':>10}"
        )
    error = np.abs(measured.model.overlap_from_distance(measured.distance) - measured.overlap)
    rows.append(f"{'error of predicted overlap, mean':34}{error.mean():12.3f}")
    rows.append(f"{f'  of pairs within {NEAR_M:.0f} m':34}{error[near].mean():12.3f}")
    return "\n".join(rows)


def robustness(measured: Measured) -> str:
    """The same scans spoilt, against the clean ones."""
    clean = np.concatenate(measured.descriptors)
    rng = np.random.default_rng(0)
    lines = []
    spoilt_kinds = {
        f"{LOST_SHARE:.0%} of packets lost": [with_lost_packets(world, rng) for world in measured.worlds],
        "32 beams, 512 columns": [world.seen_by(4, 2) for world in measured.worlds],
    }
    for name, worlds in spoilt_kinds.items():
        spoilt = [describe(measured.model, world) for world in worlds]
        both = zip(spoilt, measured.descriptors, strict=True)
        # Each pair counts once, its first scan spoilt.
        crossed = np.concatenate([pairs(descriptor_distances(some, whole)) for some, whole in both])
        found = measured.recalls(descriptor_distances(np.concatenate(spoilt), clean), 1)
        moved = np.linalg.norm(np.concatenate(spoilt) - clean, axis=1)
        lines.append(
            f"{name + ' against clean:':38}recall@1 {found:.3f}, Spearman "
            f"{rank_agreement(crossed, measured.overlap):.3f}, moves {np.median(moved):.3f} (median)"
        )
    model, world = measured.model, measured.worlds[0]
    cell = world.range_mm.shape[2] // N_COLUMNS
    whole, half = yaw_change(model, world, 37 * cell), yaw_change(model, world, cell // 2)
    lines.append(f"{'turned by whole output columns:':38}moves {whole:.1e} at most")
    lines.append(f"{'turned by half an output column:':38}moves {half:.3f} at most")
    lines.append(f"{'time per scan, one thread:':38}{milliseconds_per_scan(model, world):.2f} ms")
    return "\n".join(lines)


def plot(measured: Measured, path: Path) -> None:
    """Distance against overlap, with the calibration curve of the card."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(7, 5), layout="constrained")
    cells = axes.hexbin(measured.distance, measured.overlap, gridsize=60, bins="log", cmap="viridis", mincnt=1)
    grid = np.linspace(0, measured.distance.max(), 200)
    axes.plot(
        grid,
        measured.model.overlap_from_distance(grid),
        color="tab:red",
        label="calibration curve of the card",
    )
    axes.set(xlabel="descriptor distance", ylabel="overlap", title="Held-out virtual worlds, all pairs of scans")
    axes.legend()
    figure.colorbar(cells, label="pairs")
    figure.savefig(path, dpi=130)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", type=int, default=6)
    parser.add_argument("--model", type=Path, help="another .onnx with its card beside it")
    parser.add_argument("--plot", type=Path, help="write distance against overlap to this PNG")
    arguments = parser.parse_args()
    model = DescriptorModel.load(arguments.model)
    for name, places in {"along the patrol's route": along_route, "anywhere in the world": anywhere}.items():
        seeds = range(FIRST_SEED["test"], FIRST_SEED["test"] + arguments.worlds)
        worlds = [scan_world(seed, SCANS_PER_WORLD, 128, 1024, places) for seed in seeds]
        measured = Measured(worlds, model)
        print(
            f"model {model.model_id}, places {name}: {len(worlds)} worlds, {len(measured.overlap)} pairs of "
            f"{sum(len(world.season) for world in worlds)} OS1-128 scans, {measured.n_queries()} queries"
        )
        print(table(measured))
        print(robustness(measured), end="\n\n")
    if arguments.plot:
        plot(measured, arguments.plot)


if __name__ == "__main__":
    main()
