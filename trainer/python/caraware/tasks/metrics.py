"""The metrics by name: those of a task, the references of a headline, and their keys in reports."""

from caraware import _native


def metrics_of(task: str) -> tuple[_native.Metric, ...]:
    """The rows of `METRICS` that belong to the task with this `task.kind`."""
    return tuple(metric for metric in _native.METRICS if metric.task == task)


def reference_names(headline: _native.Metric) -> dict[str, str]:
    """The references of a headline metric by the estimator that each measures: `raw_gnss`: `raw_gnss_error_m`."""
    references = [metric.name for metric in _native.METRICS if metric.reference_for == headline.name]
    return {name.removesuffix(f"_{headline.name}"): name for name in references}


def mean_key(estimator: str, metric: str) -> str:
    """Key of an estimator's mean in reports, such as `ppo_mean_error_m`."""
    return f"{estimator}_mean_{metric}"


def interval_key(estimator: str, metric: str) -> str:
    """Key of half the 95 % confidence interval of that mean, such as `ppo_ci95_m`."""
    return f"{estimator}_ci95_{metric.rsplit('_', 1)[1]}"
