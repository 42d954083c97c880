"""`python -m caraware.examples.detector train | evaluate | run`."""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path

import torch

from caraware.examples.detector.exported import OnnxDetector, export
from caraware.examples.detector.images import CAMERA, LabelledImages, collect
from caraware.examples.detector.loop import run
from caraware.examples.detector.metric import class_precisions
from caraware.examples.detector.network import Losses
from caraware.examples.detector.training import Settings, train

TRAINING_SEEDS, HELD_OUT = range(1, 9), 1001
"""Seeds of the images that training sees, and the first one of those that it never sees."""
SECONDS, TRAINED_EVERY_S, EVALUATED_EVERY_S = 150.0, 3.0, 5.0
LEAST_SCORE = 0.02
"""For average precision, which looks at all recalls."""


def main(arguments: list[str] | None = None) -> None:
    """The command line."""
    parser = _parser()
    parsed = parser.parse_args(arguments)
    if parsed.command != "train" and not parsed.file.exists():
        parser.error(f"{parsed.file} does not exist: `train` writes it")
    torch.set_num_threads(1)  # of two cores the simulation needs one
    if parsed.command == "train":
        _train(parsed.file, parsed.steps, parsed.seed)
    elif parsed.command == "evaluate":
        for scenario in parsed.on:
            _evaluate(parsed.file, scenario, parsed.seeds)
    else:
        figures = run(OnnxDetector(parsed.file), parsed.on, parsed.seed, parsed.seconds)
        for name, figure in figures.items():
            print(f"{name:<17} {figure:8.3f}")


def _train(file: Path, steps: int, seed: int) -> None:
    began = time.perf_counter()
    images = LabelledImages.joined([collect("town", each, SECONDS, TRAINED_EVERY_S) for each in TRAINING_SEEDS])
    print(f"{len(images)} images of the town, seeds {TRAINING_SEEDS[0]} to {TRAINING_SEEDS[-1]}")
    _print_count(images)
    print(f"collected in {time.perf_counter() - began:.0f} s")

    def report(step: int, loss: Losses, elapsed_s: float) -> None:
        parts = ", ".join(f"{name} {float(part):.2f}" for name, part in loss._asdict().items())
        print(f"step {step:5} of {steps}: {parts}; {elapsed_s:.0f} s", flush=True)

    network = train(images, Settings(steps=steps, seed=seed), report)
    file.parent.mkdir(parents=True, exist_ok=True)
    export(network, file, CAMERA["camera.height"], CAMERA["camera.width"])
    spent_s, processor_s = time.perf_counter() - began, sum(os.times()[:4])
    print(f"{file} in {spent_s:.0f} s, {processor_s:.0f} s of processor time with the simulations")


def _evaluate(file: Path, scenario: str, seeds: int) -> None:
    held_out = range(HELD_OUT, HELD_OUT + seeds)
    images = LabelledImages.joined([collect(scenario, seed, SECONDS, EVALUATED_EVERY_S) for seed in held_out])
    detector = OnnxDetector(file, LEAST_SCORE)
    found = [one for start in range(0, len(images), 16) for one in detector.detect(images.rgb[start : start + 16])]
    print(f"{scenario}, seeds {held_out[0]} to {held_out[-1]}: {len(images)} images")
    _print_count(images)
    for name, precision in class_precisions(found, images.objects).items():
        print(f"  AP@0.5 {name:<12} {precision:.3f}")


def _print_count(images: LabelledImages) -> None:
    for name, (counted, ignored) in images.count().items():
        print(f"  {name:<12} {counted:6} boxes, {ignored:6} ignored")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        "python -m caraware.examples.detector",
        description="Train a small detector on images of the town, measure it where it has never been, and let it "
        "fill the `object_*` fields of an observation. It needs `pip install onnx onnxruntime onnxscript`. "
        "docs/detector.md has figures.",
    )
    commands = parser.add_subparsers(dest="command", required=True)
    shared = argparse.ArgumentParser(add_help=False)
    shared.add_argument("--file", type=Path, default=Path("runs/detector.onnx"), help="the detector (%(default)s)")

    trains = commands.add_parser(
        "train",
        parents=[shared],
        help="collect images in the town and train on them",
        description="Simulates mixed traffic in the town with eight seeds, trains, writes an ONNX file, and checks "
        "that ONNX Runtime computes what torch does. One thread; less than ten minutes.",
    )
    trains.add_argument("--steps", type=int, default=Settings.steps, help="steps of the optimiser (%(default)s)")
    trains.add_argument("--seed", type=int, default=1, help="of the network and the order of images (%(default)s)")

    scenario = "a map of the project that mixed traffic drives on (town, avenue), or a .sumocfg"
    evaluates = commands.add_parser(
        "evaluate",
        parents=[shared],
        help="average precision on images that training never saw",
        description="Simulates seeds that training does not use and prints AP at an IoU of 0.5, PASCAL VOC's with all "
        "points. Objects that are too small, hidden or cut off count neither as hit nor as miss (KITTI's rule).",
    )
    evaluates.add_argument("--on", nargs="+", default=["town", "avenue"], metavar="SCENARIO", help=scenario)
    evaluates.add_argument("--seeds", type=int, default=3, help=f"number of seeds, from {HELD_OUT} on (%(default)s)")

    runs = commands.add_parser(
        "run",
        parents=[shared],
        help="fill `object_*` fields in a running simulation",
        description="Runs a simulation whose observations get their `object_*` fields from the detector, and prints "
        "how far these are from the truth. Recall and precision are of objects within 40 m at a score of 0.3.",
    )
    runs.add_argument("--on", default="town", metavar="SCENARIO", help=scenario)
    runs.add_argument("--seed", type=int, default=HELD_OUT, help="of traffic and light (%(default)s)")
    runs.add_argument("--seconds", type=float, default=40.0, help="simulated time (%(default)s)")
    return parser


if __name__ == "__main__":
    main()
