"""Trains the descriptor, from a seed to ONNX file and card:

    python -m revisitd.models.train --out DIR --seed 0

The scan set and the last checkpoint are kept in DIR: a run that was stopped goes on where it was.
"""

from __future__ import annotations

import argparse
import logging
import multiprocessing
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch.nn import functional

from .batches import FeaturesOfWorld, draw_batch, features_of_world
from .export import write_model
from .metrics import descriptor_distances, pairs, rank_agreement
from .network import DescriptorNetwork
from .scan_sets import FIRST_SEED, cached_world

BATCH = 128
PEAK_RATE = 3e-3
WEIGHT_DECAY = 5e-2
ERROR_SCALE = 0.1  # of the overlap: smaller errors count by their square, larger ones linearly
APART_WEIGHT = 0.15
RANK_WEIGHT = 0.2
CHECKPOINT_STEPS = 500
THREADS = 1
PROCESSES = 2  # that prepare worlds

log = logging.getLogger(__name__)


class Trainer:
    """Network, optimiser and step; resumable."""

    def __init__(self, out: Path, seed: int, n_steps: int):
        torch.manual_seed(seed)
        self.out, self.seed, self.n_steps, self.step = out, seed, n_steps, 0
        self.network = DescriptorNetwork()
        self.optimizer = torch.optim.AdamW(self.network.parameters(), PEAK_RATE, weight_decay=WEIGHT_DECAY)
        self.schedule = torch.optim.lr_scheduler.OneCycleLR(self.optimizer, PEAK_RATE, n_steps, pct_start=0.15)

    def train(self, worlds: list[FeaturesOfWorld], validation: list[FeaturesOfWorld]) -> None:
        """Runs to the last step, with a checkpoint and a line of the curve every CHECKPOINT_STEPS."""
        begun, losses = time.monotonic(), []
        while self.step < self.n_steps:
            losses.append(self._advance(worlds))
            if self.step % CHECKPOINT_STEPS == 0 or self.step == self.n_steps:
                agreement = rank_agreement(*validation_pairs(self.network, validation))
                self._note(float(np.mean(losses)), agreement, time.monotonic() - begun)
                self.save()
                losses.clear()

    def _advance(self, worlds: list[FeaturesOfWorld]) -> float:
        # Batch and dropout depend on seed and step alone: a resumed run does what an unbroken one does.
        scans, overlap = draw_batch(worlds, np.random.default_rng((self.seed, self.step)), BATCH)
        torch.manual_seed(self.seed * 1_000_003 + self.step)
        self.network.train()
        loss = overlap_loss(self.network(**scans), overlap)
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
    """Regression of the cosine on the overlap, plus ranking; (W * n, 256) unit vectors, (W, n, n) true overlaps.

    Cosine = overlap makes distance = sqrt(2 - 2 overlap), which falls with overlap over the whole range; scans of two
    worlds share nothing. The ranking term asks that distances correlate with the ranks of the overlaps, over all pairs
    of the batch that are of one world: it is the benchmark's own figure, but for the ranks of the distances.
    """
    cosine = descriptors @ descriptors.T
    n_worlds, n, _ = overlap.shape
    world = torch.arange(n_worlds).repeat_interleave(n)
    one, other = torch.triu_indices(len(cosine), len(cosine), 1)
    same = world[one] == world[other]
    inside, across = cosine[one, other][same], cosine[one, other][~same]
    wanted = torch.block_diag(*overlap)[one, other][same]
    regression = functional.smooth_l1_loss(inside, wanted, beta=ERROR_SCALE)
    # Places of two worlds may look alike: being nearer than chance is wrong, being farther is not.
    apart = functional.smooth_l1_loss(across.clamp(min=0.0), torch.zeros_like(across), beta=ERROR_SCALE)
    distance = torch.sqrt((2.0 - 2.0 * inside).clamp(min=1e-6))
    rank = torch.argsort(torch.argsort(wanted)).float()
    agreement = -torch.corrcoef(torch.stack((distance, rank)))[0, 1]
    return regression + APART_WEIGHT * apart + RANK_WEIGHT * (1.0 - agreement)


def prepare(folder: Path, role: str, count: int) -> list[FeaturesOfWorld]:
    """The first worlds of a role; those that the folder does not hold are scanned into it."""
    folder.mkdir(parents=True, exist_ok=True)
    seeds = range(FIRST_SEED[role], FIRST_SEED[role] + count)
    worlds = []
    with ProcessPoolExecutor(PROCESSES, multiprocessing.get_context("spawn")) as pool:
        for world in pool.map(partial(_prepared, folder, role == "train"), seeds):
            worlds.append(world)
            log.info("%s world %d of %d", role, len(worlds), count)
    return worlds


def _prepared(folder: Path, spoilt: bool, seed: int) -> FeaturesOfWorld:
    return features_of_world(cached_world(folder, seed), spoilt)


@torch.no_grad()
def validation_pairs(network: DescriptorNetwork, worlds: list[FeaturesOfWorld]) -> tuple[np.ndarray, np.ndarray]:
    """Distances and overlaps of all pairs of each world, once through each sensor."""
    network.eval()
    distances, overlaps = [], []
    for world in worlds:
        for variant in range(world.n_variants):
            scans = world.take(variant, np.arange(len(world.overlap)))
            distances.append(pairs(descriptor_distances(network(**scans).numpy())))
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
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--worlds", type=int, default=170, help="training worlds; a sixth more for validation")
    arguments = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    torch.set_num_threads(THREADS)
    arguments.out.mkdir(parents=True, exist_ok=True)
    training = prepare(arguments.out / "scans", "train", arguments.worlds)
    validation = prepare(arguments.out / "scans", "validation", max(arguments.worlds // 6, 2))
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
            "first_training_seed": FIRST_SEED["train"],
            "validation_worlds": len(validation),
            "first_validation_seed": FIRST_SEED["validation"],
            "scans": sum(len(world.overlap) for world in training),
        },
        training={"seed": arguments.seed, "steps": arguments.steps, "batch": BATCH},
    )


if __name__ == "__main__":
    main()
