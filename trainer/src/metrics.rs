//! The table of metrics for Python.

use ipc_schema::metric::{MetricDirection, MetricSpec};
use pyo3::prelude::*;

/// A row of `METRICS`.
#[pyclass(frozen, get_all, module = "caraware._native")]
pub(crate) struct Metric {
    /// Name, which ends in its unit: the key in reports, logs and plots.
    name: &'static str,
    /// Name in displays.
    label: &'static str,
    /// Unit in displays.
    unit: &'static str,
    /// True if larger values are better, as with progress; false as with an error.
    higher_is_better: bool,
    /// `task.kind` of the task that measures it.
    task: &'static str,
    /// Name of the policy's metric that this one is a reference for, measured without the policy on the same samples.
    reference_for: Option<&'static str>,
}

impl Metric {
    pub(crate) fn of(spec: &MetricSpec) -> Self {
        Self {
            name: spec.name,
            label: spec.label,
            unit: spec.unit,
            higher_is_better: spec.direction == MetricDirection::HigherIsBetter,
            task: spec.task.name(),
            reference_for: spec.reference_for,
        }
    }
}
