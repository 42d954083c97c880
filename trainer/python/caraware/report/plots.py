"""The two pictures of a run: error and exploration over training, as PNG files without a display."""

from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, LogLocator, NullFormatter, StrMethodFormatter

from caraware.report.evaluation import EvaluationResult
from caraware.report.metrics import TrainingPoint

POLICY, EVALUATION, RAW, REWARD = "#7fb3d5", "#1a5276", "#b03a2e", "#ca6f1e"
EKF, RTS, SUPERVISED = "#e69f00", "#555555", "#009e73"
"""Colour-blind readers can distinguish them: they differ in lightness, and lines in their dashes and marks."""


def plot_error(file: Path, training: list[TrainingPoint], evaluations: list[EvaluationResult]) -> None:
    """Mean position error of the policy in training and in evaluations, against the baselines, over env steps."""
    figure, axes = _figure("Position error of the policy against raw GNSS and filters")
    axes.plot(
        [p.env_steps for p in training],
        [p.metrics["error_m"] for p in training],
        color=POLICY,
        label="policy, training",
    )
    raw_m = _last_raw_m(training, evaluations)
    if raw_m is not None:
        axes.axhline(raw_m, color=RAW, linestyle="--", label=f"raw GNSS ({raw_m:.2f} m)")
    _plot_evaluated(axes, evaluations, "supervised", "the same network, taught the truth", SUPERVISED, "--", "D")
    _plot_evaluated(axes, evaluations, "ekf", "EKF, same samples", EKF, "-.", "s")
    _plot_evaluated(axes, evaluations, "rts", "RTS smoother, sees the future: a bound", RTS, ":", "^")
    _plot_evaluated(axes, evaluations, "ppo", "policy, evaluation on unseen seeds", EVALUATION, "-", "o")
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.set_ylabel("mean position error [m]")
    axes.legend(frameon=False, fontsize=9)
    _save(figure, file)


def _plot_evaluated(
    axes: Axes, evaluations: list[EvaluationResult], name: str, label: str, colour: str, dashes: str, marker: str
) -> None:
    """One estimator's mean errors, if it has any, with 95 % intervals: over seeds, of one seed over its vehicles."""
    known = [e for e in evaluations if name in e.estimates]
    if not known:
        return
    steps, means_m = [e.env_steps for e in known], [e.estimates[name].mean for e in known]
    halves_m, seeds = [e.estimates[name].half_width() for e in known], known[-1].episodes
    last = f"last {means_m[-1]:.2f} ± {halves_m[-1]:.2f} m" + (f", {seeds} seeds" if seeds > 1 else "")
    axes.errorbar(
        steps,
        means_m,
        yerr=halves_m,
        color=colour,
        linestyle=dashes,
        marker=marker,
        markersize=4,
        linewidth=1.5,
        capsize=2,
        label=f"{label} ({last})",
    )


def plot_sigma(file: Path, training: list[TrainingPoint]) -> None:
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


def _last_raw_m(training: list[TrainingPoint], evaluations: list[EvaluationResult]) -> float | None:
    if evaluations:
        return evaluations[-1].mean("raw_gnss")
    return training[-1].metrics["raw_gnss_error_m"] if training else None


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
