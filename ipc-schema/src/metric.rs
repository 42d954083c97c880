//! The metrics of the tasks: name, unit, task, and which values are better.
//!
//! A trainer reports the metrics of its task on its board; the progress line, `caraware ps`, the fan-out's status, the HUD and
//! the native extension derive theirs from [`METRICS`]. A new metric is a row here and a value that the task measures.

use serde::{Deserialize, Serialize, Serializer};

use crate::config::TaskKind;

/// Which values of a metric are better.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MetricDirection {
    /// Smaller values are better, as with an error.
    LowerIsBetter,
    /// Larger values are better, as with progress.
    HigherIsBetter,
}

/// A metric.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MetricSpec {
    /// Name, which ends in its unit: the key in reports, logs and plots.
    pub name: &'static str,
    /// Name in displays.
    pub label: &'static str,
    /// Unit in displays.
    pub unit: &'static str,
    /// Which values are better.
    pub direction: MetricDirection,
    /// The task that measures it.
    pub task: TaskKind,
    /// The metric of the policy that this one is a reference for, measured without the policy on the same samples. Its name is
    /// that metric's after the name of the estimator that it measures: `raw_gnss` and `error_m`.
    pub reference_for: Option<&'static str>,
}

impl MetricSpec {
    /// What this metric measures, as keys of a report begin: the policy, `ppo`, or of a reference its estimator.
    #[must_use]
    pub fn estimator(&self) -> &'static str {
        match self.reference_for {
            Some(of_policy) => self.name.trim_end_matches(of_policy).trim_end_matches('_'),
            None => "ppo",
        }
    }

    /// Key of an estimator's mean in a report, such as `ppo_mean_error_m`.
    #[must_use]
    pub fn mean_key(&self, estimator: &str) -> String {
        format!("{estimator}_mean_{}", self.name)
    }

    /// Key of half the 95 % confidence interval of that mean, such as `ppo_ci95_m`.
    #[must_use]
    pub fn interval_key(&self, estimator: &str) -> String {
        let unit = self.name.rsplit('_').next().unwrap_or(self.name);
        format!("{estimator}_ci95_{unit}")
    }
}

/// A metric that measures the policy, in a configuration. It is written as its name.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "&'static str")]
pub struct PolicyMetric(&'static MetricSpec);

impl PolicyMetric {
    /// All of them, in the order of [`METRICS`].
    pub fn all() -> impl Iterator<Item = Self> {
        METRICS.iter().filter(|metric| metric.reference_for.is_none()).map(Self)
    }

    /// The metric called `name`; `None` if there is none, or if it measures a reference.
    #[must_use]
    pub fn by_name(name: &str) -> Option<Self> {
        Self::all().find(|metric| metric.spec().name == name)
    }

    /// Its row of [`METRICS`].
    #[must_use]
    pub const fn spec(self) -> &'static MetricSpec {
        self.0
    }
}

/// No metric of the policy has this name.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("no metric of the policy is called \"{0}\"")]
pub struct UnknownMetric(String);

impl TryFrom<String> for PolicyMetric {
    type Error = UnknownMetric;

    fn try_from(name: String) -> Result<Self, UnknownMetric> {
        Self::by_name(&name).ok_or(UnknownMetric(name))
    }
}

impl From<PolicyMetric> for &'static str {
    fn from(metric: PolicyMetric) -> Self {
        metric.spec().name
    }
}

/// Every metric, in the order of [`MetricValues`]. The first metric of a task is its headline.
pub const METRICS: [MetricSpec; 10] = [
    MetricSpec {
        name: "error_m",
        label: "error",
        unit: "m",
        direction: MetricDirection::LowerIsBetter,
        task: TaskKind::Localisation,
        reference_for: None,
    },
    MetricSpec {
        name: "raw_gnss_error_m",
        label: "raw GNSS",
        unit: "m",
        direction: MetricDirection::LowerIsBetter,
        task: TaskKind::Localisation,
        reference_for: Some("error_m"),
    },
    MetricSpec {
        name: "progress_mps",
        label: "progress",
        unit: "m/s",
        direction: MetricDirection::HigherIsBetter,
        task: TaskKind::Driving,
        reference_for: None,
    },
    MetricSpec {
        name: "route_offset_m",
        label: "beside the route",
        unit: "m",
        direction: MetricDirection::LowerIsBetter,
        task: TaskKind::Driving,
        reference_for: None,
    },
    MetricSpec {
        name: "lateral_error_m",
        label: "lateral error",
        unit: "m",
        direction: MetricDirection::LowerIsBetter,
        task: TaskKind::Lane,
        reference_for: None,
    },
    MetricSpec {
        name: "wrong_lane_percent",
        label: "wrong lane",
        unit: "%",
        direction: MetricDirection::LowerIsBetter,
        task: TaskKind::Lane,
        reference_for: None,
    },
    MetricSpec {
        name: "raw_gnss_lateral_error_m",
        label: "raw GNSS",
        unit: "m",
        direction: MetricDirection::LowerIsBetter,
        task: TaskKind::Lane,
        reference_for: Some("lateral_error_m"),
    },
    MetricSpec {
        name: "raw_gnss_wrong_lane_percent",
        label: "raw GNSS",
        unit: "%",
        direction: MetricDirection::LowerIsBetter,
        task: TaskKind::Lane,
        reference_for: Some("wrong_lane_percent"),
    },
    MetricSpec {
        name: "awareness_percent",
        label: "awareness",
        unit: "%",
        direction: MetricDirection::HigherIsBetter,
        task: TaskKind::Messages,
        reference_for: None,
    },
    MetricSpec {
        name: "message_kbitps",
        label: "messages",
        unit: "kbit/s",
        direction: MetricDirection::LowerIsBetter,
        task: TaskKind::Messages,
        reference_for: None,
    },
];

/// Number of metrics that a board has room for.
pub const METRIC_CAPACITY: usize = 12;
const _: () = assert!(
    METRICS.len() <= METRIC_CAPACITY,
    "a board has room for METRIC_CAPACITY metrics"
);

/// The value of each metric, in the order of [`METRICS`]; not-a-number for a metric that is not measured.
pub type MetricValues = [f64; METRIC_CAPACITY];

/// Values without any measured metric.
pub const NOT_MEASURED: MetricValues = [f64::NAN; METRIC_CAPACITY];

/// The metrics that are measured, with their values.
pub fn measured(values: &MetricValues) -> impl Iterator<Item = (&'static MetricSpec, f64)> {
    METRICS.iter().zip(*values).filter(|(_, value)| value.is_finite())
}

/// Writes the metrics that are measured as a list of name, label, unit and value.
///
/// # Errors
/// Those of the serializer.
pub fn serialize_measured<S: Serializer>(values: &MetricValues, serializer: S) -> Result<S::Ok, S::Error> {
    #[derive(Serialize)]
    struct Measured {
        name: &'static str,
        label: &'static str,
        unit: &'static str,
        value: f64,
    }
    serializer.collect_seq(measured(values).map(|(metric, value)| Measured {
        name: metric.name,
        label: metric.label,
        unit: metric.unit,
        value,
    }))
}

/// The metric that a task is judged by.
#[must_use]
pub fn headline(task: TaskKind) -> &'static MetricSpec {
    match task {
        TaskKind::Localisation => &METRICS[0],
        TaskKind::Driving => &METRICS[2],
        TaskKind::Lane => &METRICS[4],
        TaskKind::Messages => &METRICS[8],
    }
}

/// Position of the metric called `name` in [`METRICS`].
#[must_use]
pub fn place_of(name: &str) -> Option<usize> {
    METRICS.iter().position(|metric| metric.name == name)
}

/// All measured metrics in a line, such as `error 3.20 m (raw GNSS 4.10 m)`; empty if nothing is measured.
#[must_use]
pub fn summary(values: &MetricValues) -> String {
    let text = |metric: &MetricSpec, value: f64| format!("{} {value:.2} {}", metric.label, metric.unit);
    let of_policy = measured(values).filter(|(metric, _)| metric.reference_for.is_none());
    let with_references = of_policy.map(|(metric, value)| {
        let references: Vec<String> = measured(values)
            .filter(|(other, _)| other.reference_for == Some(metric.name))
            .map(|(other, value)| text(other, value))
            .collect();
        if references.is_empty() {
            text(metric, value)
        } else {
            format!("{} ({})", text(metric, value), references.join(", "))
        }
    });
    with_references.collect::<Vec<_>>().join("  ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_unique_and_end_in_their_unit() {
        for (place, metric) in METRICS.iter().enumerate() {
            assert_eq!(place_of(metric.name), Some(place), "{}", metric.name);
            let unit = metric.unit.replace('/', "p").replace('%', "percent");
            assert!(metric.name.ends_with(&format!("_{unit}")), "{}", metric.name);
        }
    }

    #[test]
    fn the_headline_is_the_first_metric_of_its_task() {
        for task in [
            TaskKind::Localisation,
            TaskKind::Driving,
            TaskKind::Lane,
            TaskKind::Messages,
        ] {
            let first = METRICS.iter().find(|metric| metric.task == task).unwrap();
            assert_eq!(headline(task), first);
        }
        let error = headline(TaskKind::Localisation);
        assert_eq!(error.mean_key("ppo"), "ppo_mean_error_m");
        assert_eq!(error.interval_key("raw_gnss"), "raw_gnss_ci95_m");
        assert_eq!(error.estimator(), "ppo");
    }

    #[test]
    fn a_reference_is_for_a_metric_of_the_policy_in_the_same_task() {
        for metric in METRICS {
            let Some(name) = metric.reference_for else { continue };
            let of_policy = METRICS[place_of(name).unwrap()];
            assert_eq!((of_policy.reference_for, of_policy.task), (None, metric.task));
            assert_eq!(format!("{}_{name}", metric.estimator()), metric.name);
            assert_eq!((of_policy.unit, of_policy.direction), (metric.unit, metric.direction));
        }
    }

    #[test]
    fn a_metric_of_the_policy_is_written_as_its_name() {
        let names: Vec<&str> = PolicyMetric::all().map(|metric| metric.spec().name).collect();
        let of_tasks = [
            "error_m",
            "progress_mps",
            "route_offset_m",
            "lateral_error_m",
            "wrong_lane_percent",
            "awareness_percent",
            "message_kbitps",
        ];
        assert_eq!(names, of_tasks);
        let metric: PolicyMetric = serde_json::from_str("\"error_m\"").unwrap();
        assert_eq!(serde_json::to_string(&metric).unwrap(), "\"error_m\"");
        let error = serde_json::from_str::<PolicyMetric>("\"raw_gnss_error_m\"").unwrap_err();
        assert!(error.to_string().contains("no metric of the policy"), "{error}");
    }

    #[test]
    fn a_summary_has_references_in_brackets_and_only_measured_metrics() {
        let mut values = NOT_MEASURED;
        assert_eq!(summary(&values), "");
        values[0] = 3.2;
        assert_eq!(summary(&values), "error 3.20 m");
        values[1] = 4.1;
        assert_eq!(summary(&values), "error 3.20 m (raw GNSS 4.10 m)");
        let mut values = NOT_MEASURED;
        (values[2], values[3]) = (5.0, 0.25);
        assert_eq!(summary(&values), "progress 5.00 m/s  beside the route 0.25 m");
    }
}
