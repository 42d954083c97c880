"""The two pictures of a run: the task's metric and exploration over training, as PNG files without a display."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, LogLocator, NullFormatter, StrMethodFormatter

from caraware import _native
from caraware.report.evaluation import ESTIMATORS, EvaluationResult
from caraware.report.metrics import TrainingPoint
from caraware.tasks.metrics import reference_names

POLICY, EVALUATION, REFERENCE, REWARD = "#7fb3d5", "#1a5276", "#b03a2e", "#ca6f1e"
EKF, MAP_EKF, RTS, SUPERVISED = "#e69f00", "#cc79a7", "#555555", "#009e73"
"""Colour-blind readers can distinguish them: they differ in lightness, and lines in their dashes and marks."""


@dataclass(frozen=True)
class _Curve:
    """How an estimator is drawn."""

    estimator: str
    label: str
    colour: str
    dashes: str
    marker: str


CURVES = (
    _Curve("supervised", "the same network, taught the truth by as many steps", SUPERVISED, "--", "D"),
    _Curve("ekf", "EKF, same samples", EKF, "-.", "s"),
    _Curve("map_ekf", "EKF with a map, same samples", MAP_EKF, "-.", "v"),
    _Curve("rts", "RTS smoother, sees the future: a bound", RTS, ":", "^"),
    _Curve("ppo", "policy, evaluation on unseen seeds", EVALUATION, "-", "o"),
)


def plot_headline(
    folder: Path, metric: _native.Metric, training: Sequence[TrainingPoint], evaluations: list[EvaluationResult]
) -> None:
    """Mean of the task's headline metric in training and in evaluations, against the baselines, over env steps.

    The file is called by the metric's quantity, such as `error.png`.
    """
    figure, axes = _figure(f"{metric.label.capitalize()} of the policy and of its baselines")
    axes.plot(
        [p.env_steps for p in training],
        [p.metrics[metric.name] for p in training],
        color=POLICY,
        label="policy, training",
    )
    for estimator, name in reference_names(metric).items():
        value = _last_reference(training, evaluations, estimator, name)
        if value is not None:
            label = f"{ESTIMATORS[estimator]} ({value:.2f} {metric.unit})"
            axes.axhline(value, color=REFERENCE, linestyle="--", label=label)
    for curve in CURVES:
        _plot_evaluated(axes, evaluations, curve, metric.unit)
    if not metric.higher_is_better:
        # An error is positive, and its last tenths count.
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.yaxis.set_minor_formatter(NullFormatter())
    axes.set_ylabel(f"mean {metric.label} [{metric.unit}]")
    axes.legend(frameon=False, fontsize=9)
    _save(figure, folder / f"{metric.name.rsplit('_', 1)[0]}.png")


def _plot_evaluated(axes: Axes, evaluations: list[EvaluationResult], curve: _Curve, unit: str) -> None:
    """One estimator's means, if it has any, with 95 % intervals: over seeds, of one seed over its vehicles."""
    name = curve.estimator
    known = [e for e in evaluations if name in e.estimates]
    if not known:
        return
    steps, means = [e.env_steps for e in known], [e.estimates[name].mean for e in known]
    halves, seeds = [e.estimates[name].half_width() for e in known], known[-1].episodes
    last = f"last {means[-1]:.2f} ± {halves[-1]:.2f} {unit}" + (f", {seeds} seeds" if seeds > 1 else "")
    axes.errorbar(
        steps,
        means,
        yerr=halves,
        color=curve.colour,
        linestyle=curve.dashes,
        marker=curve.marker,
        markersize=4,
        linewidth=1.5,
        capsize=2,
        label=f"{curve.label} ({last})",
    )


def plot_sigma(file: Path, training: Sequence[TrainingPoint]) -> None:
    """Standard deviation of the policy and mean reward over env steps (the paper's figure 7)."""
    figure, axes = _figure("Exploration and reward")
    steps = [p.env_steps for p in training]
    axes.plot(steps, [p.sigma for p in training], color=EVALUATION)
    axes.set_ylabel("σ of the policy [half map widths]", color=EVALUATION)
    axes.set_ylim(bottom=0)
    right = axes.twinx()
    right.plot(steps, [p.reward for p in training], color=REWARD)
    right.set_ylabel("mean reward per sample [-]", color=REWARD)
    right.set_ylim(bottom=0)
    right.spines["top"].set_visible(False)
    _save(figure, file)


def _last_reference(
    training: Sequence[TrainingPoint], evaluations: list[EvaluationResult], estimator: str, name: str
) -> float | None:
    """The newest value of a reference metric, which evaluations hold by its estimator."""
    if evaluations:
        return evaluations[-1].mean(estimator)
    return training[-1].metrics[name] if training else None


def _figure(title: str) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(8, 4.5), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.set_title(title, loc="left", fontweight="bold")
    axes.set_xlabel("environment steps (one vehicle, one tick)")
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(which="both", alpha=0.25)
    return figure, axes


def _save(figure: Figure, file: Path) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file)
