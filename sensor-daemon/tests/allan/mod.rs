//! Overlapping Allan deviation (IEEE Std 952-2020, annex C; Riley, "Handbook of Frequency Stability Analysis", NIST SP 1065, 5.2.4).

/// The deviation over `m` samples of a rate sampled every `period_s`: the root of half the mean square of the differences between
/// neighbouring means over m samples, wherever they begin.
pub fn overlapping_deviation(rates: &[f64], m: usize) -> f64 {
    let mut sums = vec![0.0];
    for rate in rates {
        sums.push(sums[sums.len() - 1] + rate);
    }
    let pairs = sums.len() - 2 * m;
    let squares = (0..pairs).map(|i| ((sums[i + 2 * m] - 2.0 * sums[i + m] + sums[i]) / m as f64).powi(2));
    (squares.sum::<f64>() / (2.0 * pairs as f64)).sqrt()
}

/// Slope of the line through points in logarithmic axes.
pub fn slope(points: &[(f64, f64)]) -> f64 {
    let logs: Vec<(f64, f64)> = points.iter().map(|(x, y)| (x.ln(), y.ln())).collect();
    let n = logs.len() as f64;
    let mean = |of: &dyn Fn(&(f64, f64)) -> f64| logs.iter().map(of).sum::<f64>() / n;
    let (x, y) = (mean(&|p| p.0), mean(&|p| p.1));
    mean(&|p| (p.0 - x) * (p.1 - y)) / mean(&|p| (p.0 - x).powi(2))
}
