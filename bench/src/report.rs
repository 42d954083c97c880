//! The report of a measurement: one form for the terminal, for files and for the documentation.

use std::{collections::BTreeMap, fmt, path::Path, process::Command};

use caraware::failure::Exit;
use serde::{Deserialize, Serialize};

/// The results of measuring one part.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct BenchReport {
    /// The part, as `caraware bench` names it.
    pub part: String,
    /// Title of the part, one line.
    pub title: String,
    /// What is compared, and how.
    pub text: String,
    /// The command that measures it again.
    pub command: String,
    /// The machine that it was measured on.
    pub machine: MachineDescription,
    /// The figures for readers.
    pub tables: Vec<ReportTable>,
    /// The figures for programs: name with unit → value.
    pub figures: BTreeMap<String, f64>,
    /// The curves that can be drawn.
    pub curves: Vec<ReportCurve>,
    /// What the measurement found broken. The command fails if there is any.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub faults: Vec<String>,
}

impl BenchReport {
    /// A report without figures.
    #[must_use]
    pub fn new(part: &str, title: impl Into<String>, text: impl Into<String>) -> Self {
        Self {
            part: part.into(),
            title: title.into(),
            text: text.into(),
            command: format!("caraware bench {part}"),
            machine: MachineDescription::here(),
            tables: Vec::new(),
            figures: BTreeMap::new(),
            curves: Vec::new(),
            faults: Vec::new(),
        }
    }

    /// Adds a figure for programs.
    pub fn figure(&mut self, name: impl Into<String>, value: f64) {
        self.figures.insert(name.into(), value);
    }
}

impl fmt::Display for BenchReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{}\n{}\n", self.title, self.text)?;
        self.tables.iter().try_for_each(|table| writeln!(f, "{table}"))?;
        write!(f, "{}", self.machine)
    }
}

/// The machine, the build and the day.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct MachineDescription {
    /// The processor's name.
    pub processor: String,
    /// Cores that this process may use.
    pub cores: usize,
    /// Memory, GiB.
    pub memory_gib: u64,
    /// The revision measured; "+" if files differ from it.
    pub revision: String,
    /// Day of the measurement, UTC.
    pub date: String,
}

impl MachineDescription {
    /// This machine, now.
    #[must_use]
    pub fn here() -> Self {
        let read = |path| std::fs::read_to_string(path).unwrap_or_default();
        let value = |text: &str, key: &str| {
            text.lines()
                .find_map(|line| line.strip_prefix(key)?.split_once(':'))
                .map(|(_, value)| value.trim().to_owned())
        };
        let memory_kib = value(&read("/proc/meminfo"), "MemTotal")
            .and_then(|text| text.split_whitespace().next()?.parse::<u64>().ok())
            .unwrap_or_default();
        Self {
            processor: value(&read("/proc/cpuinfo"), "model name").unwrap_or_else(|| "unknown".into()),
            cores: std::thread::available_parallelism().map_or(1, Into::into),
            memory_gib: memory_kib.div_ceil(1 << 20),
            revision: revision(),
            date: jiff::Timestamp::now().strftime("%Y-%m-%d").to_string(),
        }
    }
}

impl fmt::Display for MachineDescription {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            processor,
            cores,
            memory_gib,
            revision,
            date,
        } = self;
        writeln!(
            f,
            "{processor}, {cores} cores, {memory_gib} GiB; revision {revision}; {date}"
        )
    }
}

fn revision() -> String {
    let git = |arguments: &[&str]| {
        let output = Command::new("git")
            .args(["-C", env!("CARGO_MANIFEST_DIR")])
            .args(arguments)
            .output()
            .ok()?;
        (output.status.success()).then(|| String::from_utf8_lossy(&output.stdout).trim().to_owned())
    };
    // The documentation, which holds the kept figures, does not change the measured programs.
    let measured = ["--", ":(top)", ":(top,exclude)docs"];
    let status = [&["status", "--porcelain", "--untracked-files=no"][..], &measured].concat();
    let changed = git(&status).is_some_and(|text| !text.is_empty());
    git(&["rev-parse", "--short=7", "HEAD"]).map_or_else(
        || env!("CARGO_PKG_VERSION").into(),
        |revision| if changed { revision + "+" } else { revision },
    )
}

/// Rows of text under column names.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ReportTable {
    /// Title over the rows; may be empty.
    pub title: String,
    /// Names of the columns, with units.
    pub columns: Vec<String>,
    /// The rows; each as long as `columns`.
    pub rows: Vec<Vec<String>>,
}

impl ReportTable {
    /// A table without rows.
    #[must_use]
    pub fn new(title: impl Into<String>, columns: &[&str]) -> Self {
        Self {
            title: title.into(),
            columns: columns.iter().map(|name| (*name).to_owned()).collect(),
            rows: Vec::new(),
        }
    }

    /// Adds a row.
    pub fn push(&mut self, cells: Vec<String>) {
        self.rows.push(cells);
    }

    /// Adds a row of cells, one for each column.
    pub fn row<const N: usize>(&mut self, cells: [String; N]) {
        self.rows.push(cells.into());
    }

    /// The table in Markdown.
    #[must_use]
    pub fn markdown(&self) -> String {
        let line = |cells: &[String]| format!("| {} |\n", cells.join(" | "));
        let mut text = line(&self.columns);
        text += &line(&vec!["---".to_owned(); self.columns.len()]);
        text += &self.rows.iter().map(|row| line(row)).collect::<String>();
        text
    }
}

impl fmt::Display for ReportTable {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if !self.title.is_empty() {
            writeln!(f, "{}", self.title)?;
        }
        let lines = || std::iter::once(&self.columns).chain(&self.rows);
        let width = |column: usize| {
            let cells = lines().filter_map(|cells| cells.get(column));
            cells.map(|cell| cell.chars().count()).max().unwrap_or_default()
        };
        let widths: Vec<usize> = (0..self.columns.len()).map(width).collect();
        for cells in lines() {
            let padded: Vec<String> = cells
                .iter()
                .zip(&widths)
                .enumerate()
                .map(|(column, (cell, &width))| match column {
                    0 => format!("{cell:<width$}"),
                    _ => format!("{cell:>width$}"),
                })
                .collect();
            writeln!(f, "  {}", padded.join("  ").trim_end())?;
        }
        Ok(())
    }
}

/// A picture: lines over one quantity.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ReportCurve {
    /// Name of the picture's file, without extension.
    pub name: String,
    /// Title over it.
    pub title: String,
    /// The horizontal axis, with unit.
    pub x: String,
    /// The vertical axis, with unit.
    pub y: String,
    /// True for each logarithmic axis: horizontal, vertical.
    pub logarithmic: [bool; 2],
    /// The lines.
    pub lines: Vec<CurveLine>,
}

/// One line of a [`ReportCurve`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CurveLine {
    /// What it shows.
    pub name: String,
    /// Its points.
    pub points: Vec<[f64; 2]>,
}

/// Median, smallest and largest of repeated measurements.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct MedianSpread {
    /// The middle value; for an even number of values, the mean of the middle two.
    pub median: f64,
    /// The smallest.
    pub smallest: f64,
    /// The largest.
    pub largest: f64,
}

impl MedianSpread {
    /// Computes the spread of at least one value.
    ///
    /// # Errors
    /// There is no value.
    pub fn of(values: impl IntoIterator<Item = f64>) -> Result<Self, Exit> {
        let mut values: Vec<f64> = values.into_iter().collect();
        values.sort_by(f64::total_cmp);
        let (Some(&smallest), Some(&largest)) = (values.first(), values.last()) else {
            return Err(Exit::run("a measurement without a value", ""));
        };
        let middle = values.len() / 2;
        let median = match values.len() % 2 {
            0 => f64::midpoint(values[middle - 1], values[middle]),
            _ => values[middle],
        };
        Ok(Self {
            median,
            smallest,
            largest,
        })
    }
}

/// A 95 % interval of the median of the distribution that `values` come from, by their order alone: the largest rank from each end that
/// holds it with at least that probability (W. Conover, Practical Nonparametric Statistics, section 3.2).
///
/// # Errors
/// There are fewer than six values, of which even the smallest and the largest do not hold it that surely.
pub fn median_interval(values: &[f64]) -> Result<[f64; 2], Exit> {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let count = sorted.len();
    // Probability that fewer than `rank` of `count` values lie below the median: the lower tail of a binomial distribution.
    let mut term = 0.5_f64.powi(i32::try_from(count).unwrap_or(i32::MAX));
    let (mut tail, mut rank) = (term, 0);
    while rank < count / 2 && tail <= 0.025 {
        rank += 1;
        #[expect(clippy::cast_precision_loss, reason = "some dozens")]
        let odds = (count + 1 - rank) as f64 / rank as f64;
        term *= odds;
        tail += term;
    }
    match rank {
        0 => Err(Exit::run(
            format!("{count} values have no 95 % interval of their median"),
            "",
        )),
        _ => Ok([sorted[rank - 1], sorted[count - rank]]),
    }
}

impl fmt::Display for MedianSpread {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let digits = f.precision().unwrap_or(2);
        write!(
            f,
            "{:.digits$} ({:.digits$}–{:.digits$})",
            self.median, self.smallest, self.largest
        )
    }
}

/// Writes reports as JSON.
///
/// # Errors
/// The file is not writable.
pub fn write_json(path: &Path, reports: &(impl Serialize + ?Sized)) -> Result<(), Exit> {
    let text = serde_json::to_string_pretty(reports).map_err(std::io::Error::from);
    text.and_then(|text| std::fs::write(path, text + "\n"))
        .map_err(|error| Exit::io("write", path, &error))
}

/// Runs a measuring program that takes `--json FILE`, and reads that file. Its standard output goes to standard error.
///
/// # Errors
/// The program cannot be started, fails, or writes another form.
pub fn from_program<T: serde::de::DeserializeOwned>(mut command: Command) -> Result<T, Exit> {
    let program = command.get_program().to_string_lossy().into_owned();
    let file = std::env::temp_dir().join(format!("caraware-bench-{}.json", std::process::id()));
    let status = command
        .arg("--json")
        .arg(&file)
        .stdout(std::io::stderr())
        .status()
        .map_err(|error| Exit::io("start", program.as_ref(), &error))?;
    let text = std::fs::read_to_string(&file);
    // The file is missing if the program failed before it wrote the file.
    let _ = std::fs::remove_file(&file);
    if !status.success() {
        return Err(Exit::run(
            format!("{program} ended with {status}"),
            "its message is above",
        ));
    }
    let unwritten = |error: &dyn fmt::Display| Exit::run(format!("{program} wrote no report: {error}"), "");
    serde_json::from_str(&text.map_err(|error| unwritten(&error))?).map_err(|error| unwritten(&error))
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::float_cmp, reason = "tests assert by unwrapping")]
mod tests {
    use super::*;

    #[test]
    fn the_median_of_an_even_number_is_between_the_middle_two() {
        let spread = MedianSpread::of([4.0, 1.0, 3.0, 2.0]).unwrap();
        assert_eq!([spread.median, spread.smallest, spread.largest], [2.5, 1.0, 4.0]);
        assert_eq!(MedianSpread::of([5.0]).unwrap().median, 5.0);
        assert!(MedianSpread::of([]).is_err());
    }

    #[test]
    fn the_interval_of_a_median_has_the_ranks_of_the_binomial_distribution() {
        let ranks = |count: u32| median_interval(&(1..=count).rev().map(f64::from).collect::<Vec<_>>()).ok();
        // 1 − 2 P(B(n, ½) < rank): 96.9 % of 6, 96.1 % of 9, 97.2 % of 41.
        let expected = [
            (5, None),
            (6, Some([1.0, 6.0])),
            (9, Some([2.0, 8.0])),
            (41, Some([14.0, 28.0])),
        ];
        for (count, interval) in expected {
            assert_eq!(ranks(count), interval, "{count}");
        }
    }

    #[test]
    fn columns_are_as_wide_as_their_widest_cell() {
        let mut table = ReportTable::new("rates", &["what", "µs"]);
        table.row(["a long name".into(), "1".into()]);
        assert_eq!(table.to_string(), "rates\n  what         µs\n  a long name   1\n");
        assert_eq!(table.markdown(), "| what | µs |\n| --- | --- |\n| a long name | 1 |\n");
    }
}
