"""Trains the descriptor, from a seed to ONNX file and card:

    python -m revisitd.models.train --out DIR --seed 0

The scan set and the last checkpoint are kept in DIR: a run that was stopped goes on where it was.
"""

from __future__ import annotations

import argparse
import logging
import time
from pathlib import Path

import numpy as np
import torch
from torch.nn import functional

from .batches import StatisticsOfWorld, draw_batch, statistics_of_worlds
from .export import write_model
from .metrics import descriptor_distances, pairs, rank_agreement
from .network import DescriptorNetwork
from .scan_sets import cached_worlds

BATCH = 96
PEAK_RATE = 1e-3
WEIGHT_DECAY = 2e-2
RANK_WEIGHT = 0.1
# Differences of overlap below this are not worth ranking: they lie within the noise of the label.
RANK_MARGIN = 0.03
RANK_SHARPNESS = 20.0
CHECKPOINT_STEPS = 200
THREADS = 1

log = logging.getLogger(__name__)


class Trainer:
    """Network, optimiser and step; resumable."""

    def __init__(self, out: Path, seed: int, n_steps: int):
        torch.manual_seed(seed)
        self.out, self.seed, self.n_steps, self.step = out, seed, n_steps, 0
        self.network = DescriptorNetwork()
        self.optimizer = torch.optim.AdamW(self.network.parameters(), PEAK_RATE, weight_decay=WEIGHT_DECAY)
        self.schedule = torch.optim.lr_scheduler.OneCycleLR(self.optimizer, PEAK_RATE, n_steps, pct_start=0.1)

    def train(self, worlds: list[StatisticsOfWorld], validation: list[StatisticsOfWorld]) -> None:
        """Runs to the last step, with a checkpoint and a line of the curve every CHECKPOINT_STEPS."""
        self.network.standardise(torch.cat([world.statistics.flatten(0, 1) for world in worlds]).float())
        begun, losses = time.monotonic(), []
        while self.step < self.n_steps:
            losses.append(self._advance(worlds))
            if self.step % CHECKPOINT_STEPS == 0 or self.step == self.n_steps:
                agreement = rank_agreement(*validation_pairs(self.network, validation))
                self._note(float(np.mean(losses)), agreement, time.monotonic() - begun)
                self.save()
                losses.clear()

    def _advance(self, worlds: list[StatisticsOfWorld]) -> float:
        # Batch and dropout depend on seed and step alone: a resumed run does what an unbroken one does.
        statistics, overlap = draw_batch(worlds, np.random.default_rng((self.seed, self.step)), BATCH)
        torch.manual_seed(self.seed * 1_000_003 + self.step)
        self.network.train()
        loss = overlap_loss(self.network.head(statistics), overlap)
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()
        self.schedule.step()
        self.step += 1
        return loss.item()

    def _note(self, loss: float, agreement: float, elapsed_s: float) -> None:
        progress = (self.step, self.n_steps, loss, agreement, elapsed_s)
        log.info("step %d of %d loss %.4f validation spearman %.4f elapsed %.0f s", *progress)
        curve = self.out / "curve.csv"
        if not curve.exists():
            curve.write_text("step,loss,validation_spearman\n")
        with curve.open("a") as lines:
            lines.write(f"{self.step},{loss:.5f},{agreement:.5f}\n")

    def save(self) -> None:
        """Writes checkpoint.pt; a file of this name is always whole."""
        state = {"step": self.step, "seed": self.seed, "n_steps": self.n_steps}
        state |= {name: getattr(self, name).state_dict() for name in ("network", "optimizer", "schedule")}
        unfinished = self.out / "checkpoint.tmp"
        torch.save(state, unfinished)
        unfinished.replace(self.out / "checkpoint.pt")

    def resume(self) -> None:
        """Goes on from checkpoint.pt, if there is one of the same seed and length."""
        path = self.out / "checkpoint.pt"
        if not path.exists():
            return
        state = torch.load(path, weights_only=True)
        if (state["seed"], state["n_steps"]) != (self.seed, self.n_steps):
            raise SystemExit(f"{path} is of seed {state['seed']}, {state['n_steps']} steps: use another --out")
        self.step = state["step"]
        for name in ("network", "optimizer", "schedule"):
            getattr(self, name).load_state_dict(state[name])


def overlap_loss(descriptors: torch.Tensor, overlap: torch.Tensor) -> torch.Tensor:
    """Regression of the cosine on the overlap, plus ranking; (n, 256) unit vectors, (n, n) true overlaps.

    Cosine = overlap makes distance = sqrt(2 - 2 overlap), which falls with overlap over the whole range.
    Rarer tenths of overlap weigh more, so that the many pairs that share little do not drown the others. The
    ranking term asks, for each scan and each two others, that the one with more overlap be nearer.
    """
    cosine = descriptors @ descriptors.T
    upper = torch.triu_indices(len(overlap), len(overlap), 1)
    flat_cosine, flat_overlap = cosine[upper[0], upper[1]], overlap[upper[0], upper[1]]
    tenth = (flat_overlap * 10).long().clamp(max=9)
    weight = torch.bincount(tenth, minlength=10).clamp(min=1).float().rsqrt()[tenth]
    error = functional.smooth_l1_loss(flat_cosine, flat_overlap, reduction="none", beta=0.1)
    regression = (weight * error).sum() / weight.sum()
    gap = overlap[:, :, None] - overlap[:, None, :]
    wrong_way = functional.softplus(RANK_SHARPNESS * (cosine[:, None, :] - cosine[:, :, None]))
    # A scan beside itself ranks nothing.
    counted = (gap > RANK_MARGIN) & ~torch.eye(len(overlap), dtype=torch.bool)[:, :, None]
    ranking = (wrong_way * counted).sum() / (RANK_SHARPNESS * counted.sum().clamp(min=1))
    return regression + RANK_WEIGHT * ranking


@torch.no_grad()
def validation_pairs(network: DescriptorNetwork, worlds: list[StatisticsOfWorld]) -> tuple[np.ndarray, np.ndarray]:
    """Distances and overlaps of all pairs of each world, once through each sensor."""
    network.eval()
    distances, overlaps = [], []
    for world in worlds:
        for statistics in world.statistics:
            distances.append(pairs(descriptor_distances(network.head(statistics.float()).numpy())))
            overlaps.append(pairs(world.overlap.astype(np.float64)))
    return np.concatenate(distances), np.concatenate(overlaps)


def main() -> None:
    """Command line of the training."""
    parser = argparse.ArgumentParser(
        prog="python -m revisitd.models.train",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--out", type=Path, required=True, help="folder of scans, checkpoint, curve and model")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--worlds", type=int, default=80, help="training worlds; a tenth more for validation")
    arguments = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    torch.set_num_threads(THREADS)
    arguments.out.mkdir(parents=True, exist_ok=True)
    scans = arguments.out / "scans"
    n_validation = max(arguments.worlds // 10, 2)
    training = statistics_of_worlds(cached_worlds(scans, "train", arguments.worlds), spoilt=True)
    validation = statistics_of_worlds(cached_worlds(scans, "validation", n_validation), spoilt=False)
    trainer = Trainer(arguments.out, arguments.seed, arguments.steps)
    trainer.resume()
    trainer.train(training, validation)
    distance, overlap = validation_pairs(trainer.network, validation)
    write_model(
        trainer.network,
        arguments.out,
        distance,
        overlap,
        data={
            "training_worlds": len(training),
            "validation_worlds": len(validation),
            "scans": sum(len(world.overlap) for world in training),
        },
        training={"seed": arguments.seed, "steps": arguments.steps, "batch": BATCH},
    )


if __name__ == "__main__":
    main()
