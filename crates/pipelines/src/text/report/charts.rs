//! Charts of a report: heat map, histogram, bars, box plots, scatter plot, and the drawing of a pose. Each is one SVG; nothing to show is
//! said in its middle.

use super::svg::{Anchor, Axis, BLUE, Canvas, GRID, INK, ORANGE, VERMILION, axes};
use diorama_geom::glam::{DQuat, DVec3};

/// Width and height of a chart, and pixels left for what stands at its left, right, top and bottom.
const SIZE: [f64; 2] = [340.0, 240.0];
const MARGIN: [f64; 4] = [56.0, 12.0, 12.0, 44.0];
/// Colors from no to most words; lightness falls evenly.
const HEAT: [[f64; 3]; 4] = [[247.0, 251.0, 255.0], [158.0, 202.0, 225.0], [33.0, 113.0, 181.0], [8.0, 29.0, 70.0]];
/// Height of a bar, and the distance between groups of bars.
const BAR: f64 = 9.0;
const GAP: f64 = 7.0;
/// Values of a box that are all drawn.
const FEW: usize = 10;
/// Letters of a name beside bars, and below a box.
const NAMES: [usize; 2] = [28, 15];

/// Values of one color, one for each group of bars.
pub struct Series {
    pub name: &'static str,
    pub color: &'static str,
    pub values: Vec<f64>,
}

fn nothing(said: &str) -> String {
    let mut canvas = Canvas::new([SIZE[0], 60.0]);
    canvas.text([SIZE[0] / 2.0, 30.0], Anchor::Middle, "no data");
    canvas.finish(said)
}

fn heat(share: f64) -> String {
    let at = share.clamp(0.0, 1.0) * (HEAT.len() - 1) as f64;
    let k = (at as usize).min(HEAT.len() - 2);
    let [r, g, b] = std::array::from_fn(|c| (HEAT[k][c] + (at - k as f64) * (HEAT[k + 1][c] - HEAT[k][c])).round() as u8);
    format!("#{r:02x}{g:02x}{b:02x}")
}

/// Weights of square cells, `[columns, columns]`, rows from the top, of pictures of an `aspect` of width over height.
pub fn heat_map(weights: &[f64], columns: usize, aspect: f64, said: &str) -> String {
    let total: f64 = weights.iter().sum();
    if total <= 0.0 {
        return nothing(said);
    }
    let [left, top, width] = [MARGIN[0], MARGIN[2], 220.0];
    let height = (width / aspect).clamp(110.0, 330.0);
    let mut canvas = Canvas::new([SIZE[0], top + height + MARGIN[3]]);
    let percent = || [0.0, 50.0, 100.0].map(|v| (v, format!("{v}"))).to_vec();
    let axis = |values, pixels, name: &str| Axis { values, pixels, ticks: percent(), name: name.into() };
    let x = axis([0.0, 100.0], [left, left + width], "from the left, % of the width");
    let y = axis([100.0, 0.0], [top + height, top], "from the top, % of the height");
    canvas.rect([left, top, width, height], &heat(0.0), "");
    let most = weights.iter().copied().fold(0.0, f64::max);
    let (w, h) = (width / columns as f64, height / columns as f64);
    for (cell, weight) in weights.iter().enumerate().filter(|(_, v)| **v > 0.0) {
        let at = [left + (cell % columns) as f64 * w, top + (cell / columns) as f64 * h];
        let share = format!("{:.2} % of the words", 100.0 * weight / total);
        // A little larger than its cell, so that no line is left between cells.
        canvas.rect([at[0], at[1], w + 0.2, h + 0.2], &heat(weight / most), &share);
    }
    axes(&mut canvas, &x, &y);
    let scale = left + width + 12.0;
    for k in 0..24 {
        let share = 1.0 - k as f64 / 23.0;
        canvas.rect([scale, top + k as f64 * height / 24.0, 10.0, height / 24.0 + 0.2], &heat(share), "");
    }
    canvas.text([scale + 14.0, top + 4.0], Anchor::Start, &format!("{:.2} %", 100.0 * most / total));
    canvas.text([scale + 14.0, top + height - 4.0], Anchor::Start, "0 %");
    canvas.finish(said)
}

/// Bars side by side without gaps: counts of bins, drawn as shares of all. Ticks are at edges of bins, the first edge is 0.
pub fn histogram(counts: &[usize], ticks: Vec<(f64, String)>, name: &str, said: &str) -> String {
    let total: usize = counts.iter().sum();
    if total == 0 {
        return nothing(said);
    }
    let mut canvas = Canvas::new(SIZE);
    let share = |n: usize| 100.0 * n as f64 / total as f64;
    let most = counts.iter().map(|n| share(*n)).fold(0.0, f64::max);
    let x = Axis::new([0.0, counts.len() as f64], [MARGIN[0], SIZE[0] - MARGIN[1]], 2.0, name).with_ticks(ticks);
    let y = Axis::new([0.0, 1.05 * most], [SIZE[1] - MARGIN[3], MARGIN[2]], 5.0, "share of words, %");
    axes(&mut canvas, &x, &y);
    for (k, n) in counts.iter().enumerate().filter(|(_, n)| **n > 0) {
        let (from, to, top) = (x.at(k as f64), x.at(k as f64 + 1.0), y.at(share(*n)));
        canvas.rect([from + 0.5, top, to - from - 1.0, y.pixels[0] - top], BLUE, &format!("{:.1} %", share(*n)));
    }
    canvas.finish(said)
}

/// Bins of values by the decimal logarithm, `per_decade` from 10^`from` on to 10^`to`; those beyond an end are in the bin at that end.
pub fn log_bins(values: &[f64], [from, to]: [i32; 2], per_decade: usize) -> Vec<usize> {
    let mut out = vec![0; (to - from).max(1) as usize * per_decade];
    let last = out.len() - 1;
    for v in values.iter().filter(|v| **v > 0.0) {
        // Powers of ten belong to the bin that they begin, in spite of rounding.
        let at = ((v.log10() - from as f64) * per_decade as f64 + 1e-9).floor();
        out[at.clamp(0.0, last as f64) as usize] += 1;
    }
    out
}

/// Ticks of [`log_bins`] at powers of ten.
pub fn log_ticks([from, to]: [i32; 2], per_decade: usize) -> Vec<(f64, String)> {
    let text = |e: i32| if e < 0 { format!("{:.*}", -e as usize, 10f64.powi(e)) } else { format!("{}", 10f64.powi(e)) };
    (from..=to).map(|e| (((e - from) as usize * per_decade) as f64, text(e))).collect()
}

/// A name of at most so many letters: its end, which tells more than its beginning.
fn short(name: &str, most: usize) -> String {
    let letters: Vec<char> = name.chars().collect();
    if letters.len() <= most {
        return name.into();
    }
    let end: String = letters[letters.len() - (most - 1)..].iter().collect();
    format!("…{end}")
}

/// Bars to the right, a group for each name, with their values; the axis goes to `most`, or to the largest value. Bars stand for what `name`
/// says, with `decimals` behind the point.
pub fn bars(names: &[String], series: &[Series], (most, name, decimals): (Option<f64>, &str, usize), said: &str) -> String {
    if names.is_empty() || series.is_empty() {
        return nothing(said);
    }
    let shown: Vec<String> = names.iter().map(|n| short(n, NAMES[0])).collect();
    let letters = shown.iter().map(|n| n.chars().count()).max().unwrap_or(0);
    let left = 14.0 + 6.6 * letters as f64;
    let legend = if series.len() > 1 { 20.0 } else { 4.0 };
    let group = BAR * series.len() as f64 + GAP;
    let bottom = legend + group * names.len() as f64;
    let mut canvas = Canvas::new([left + 300.0, bottom + MARGIN[3]]);
    let largest = series.iter().flat_map(|s| &s.values).copied().filter(|v| v.is_finite()).fold(0.0, f64::max);
    let x = Axis::new([0.0, most.unwrap_or(if largest > 0.0 { largest } else { 1.0 })], [left, left + 250.0], 5.0, name);
    for (v, _) in &x.ticks {
        canvas.line(&[[x.at(*v), legend], [x.at(*v), bottom]], GRID, 1.0);
    }
    axes(&mut canvas, &x, &Axis { values: [0.0, 1.0], pixels: [bottom, legend], ticks: Vec::new(), name: String::new() });
    for (k, s) in series.iter().enumerate().filter(|_| series.len() > 1) {
        canvas.rect([left + 80.0 * k as f64, 4.0, 10.0, 10.0], s.color, "");
        canvas.text([left + 80.0 * k as f64 + 14.0, 9.0], Anchor::Start, s.name);
    }
    for (i, name) in shown.iter().enumerate() {
        let top = legend + group * i as f64 + GAP / 2.0;
        canvas.text([left - 6.0, top + BAR * series.len() as f64 / 2.0], Anchor::End, name);
        for (k, s) in series.iter().enumerate().filter(|(_, s)| s.values[i].is_finite()) {
            let (v, at) = (s.values[i], top + BAR * k as f64);
            canvas.rect([left, at, x.at(v) - left, BAR - 1.0], s.color, &format!("{} {}: {v:.decimals$}", names[i], s.name));
            // Where bars stand close, the last of the group tells its value.
            if k + 1 == series.len() {
                canvas.text([x.at(v) + 4.0, at + BAR / 2.0 - 0.5], Anchor::Start, &format!("{v:.decimals$}"));
            }
        }
    }
    canvas.finish(said)
}

/// What a box plot shows of values: box from the first to the third quartile, whiskers to the last values within 1.5 of its lengths.
#[derive(Clone, Debug, PartialEq)]
pub struct Spread {
    pub quartiles: [f64; 3],
    pub whiskers: [f64; 2],
    pub outliers: Vec<f64>,
}

impl Spread {
    /// None of no finite values.
    pub fn of(values: &[f64]) -> Option<Spread> {
        let mut sorted: Vec<f64> = values.iter().copied().filter(|v| v.is_finite()).collect();
        sorted.sort_by(f64::total_cmp);
        let last = sorted.len().checked_sub(1)?;
        let quartiles = [0.25, 0.5, 0.75].map(|share| {
            let at = share * last as f64;
            let (k, next) = (at as usize, (at as usize + 1).min(last));
            sorted[k] + (at - k as f64) * (sorted[next] - sorted[k])
        });
        let reach = 1.5 * (quartiles[2] - quartiles[0]);
        let is_near = |v: &f64| *v >= quartiles[0] - reach && *v <= quartiles[2] + reach;
        let near: Vec<f64> = sorted.iter().copied().filter(is_near).collect();
        let whiskers = [near.first().copied()?, near.last().copied()?];
        Some(Spread { quartiles, whiskers, outliers: sorted.into_iter().filter(|v| !is_near(v)).collect() })
    }
}

/// Box plots side by side, with all values where there are at most ten; `name` is what they measure.
pub fn boxes(groups: &[(String, Vec<f64>)], name: &str, said: &str) -> String {
    let spreads: Vec<(&str, &[f64], Spread)> = groups.iter().filter_map(|(n, v)| Some((&n[..], &v[..], Spread::of(v)?))).collect();
    let all = || spreads.iter().flat_map(|(_, _, s)| s.whiskers.iter().chain(&s.outliers)).copied();
    let [least, most] = [all().fold(f64::INFINITY, f64::min), all().fold(f64::NEG_INFINITY, f64::max)];
    if spreads.is_empty() {
        return nothing(said);
    }
    let [step, room] = [96.0, 0.08 * (most - least)];
    let mut canvas = Canvas::new([MARGIN[0] + step * spreads.len() as f64 + MARGIN[1], SIZE[1]]);
    let x = Axis::new([0.0, spreads.len() as f64], [MARGIN[0], MARGIN[0] + step * spreads.len() as f64], 2.0, "");
    let ticks = spreads.iter().enumerate().map(|(k, (n, ..))| (k as f64 + 0.5, short(n, NAMES[1]))).collect();
    let y = Axis::new([least - room, most + room], [SIZE[1] - MARGIN[3], MARGIN[2]], 5.0, name);
    axes(&mut canvas, &x.clone().with_ticks(ticks), &y);
    for (k, (_, values, s)) in spreads.iter().enumerate() {
        let at = |share: f64, v: f64| [x.at(k as f64 + share), y.at(v)];
        let [q1, median, q3] = s.quartiles;
        for (v, end) in [(q1, s.whiskers[0]), (q3, s.whiskers[1])] {
            canvas.line(&[at(0.5, v), at(0.5, end)], INK, 1.0);
            canvas.line(&[at(0.38, end), at(0.62, end)], INK, 1.0);
        }
        canvas.polygon(&[at(0.25, q3), at(0.75, q3), at(0.75, q1), at(0.25, q1)], "#cfe3f1", INK);
        canvas.line(&[at(0.25, median), at(0.75, median)], VERMILION, 2.0);
        // A box of few values says less than they do.
        let shown: &[f64] = if values.len() <= FEW { values } else { &s.outliers };
        shown.iter().filter(|v| v.is_finite()).for_each(|v| canvas.dot(at(0.5, *v), 2.5, INK));
    }
    canvas.finish(said)
}

/// Ends of an axis in degrees that holds all values, at multiples of 15.
fn degrees(values: impl Iterator<Item = f64>) -> [f64; 2] {
    let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(v), high.max(v)));
    [15.0 * (low / 15.0).floor(), 15.0 * (high / 15.0).ceil()]
}

/// Points in degrees along both axes, and numbers at some places.
pub fn scatter(points: &[[f64; 2]], numbers: &[([f64; 2], usize)], names: [&str; 2], said: &str) -> String {
    if points.is_empty() {
        return nothing(said);
    }
    let mut canvas = Canvas::new([SIZE[0], 300.0]);
    let ends = |k: usize| degrees(points.iter().chain(numbers.iter().map(|n| &n.0)).map(|p| p[k]));
    let x = Axis::new(ends(0), [MARGIN[0], SIZE[0] - MARGIN[1]], 5.0, names[0]);
    let y = Axis::new(ends(1), [300.0 - MARGIN[3], MARGIN[2]], 5.0, names[1]);
    axes(&mut canvas, &x, &y);
    for p in points {
        canvas.dot([x.at(p[0]), y.at(p[1])], 1.6, "#8ab8d8");
    }
    for (p, number) in numbers {
        let at = [x.at(p[0]), y.at(p[1])];
        canvas.dot(at, 7.5, "#fff");
        canvas.dot(at, 7.0, ORANGE);
        canvas.text(at, Anchor::Middle, &number.to_string());
    }
    canvas.finish(said)
}

/// A board of an `aspect` of width over height with letters on it, turned by `camera_from_region` before a camera: as it looks from there.
pub fn pose(camera_from_region: DQuat, aspect: f64, said: &str) -> String {
    /// Strokes of T E X T on a board from −1 to 1 along both sides.
    const STROKES: [[f64; 4]; 10] = [
        [-0.9, 0.6, -0.5, 0.6],
        [-0.7, 0.6, -0.7, -0.6],
        [-0.4, 0.6, -0.4, -0.6],
        [-0.4, 0.6, -0.05, 0.6],
        [-0.4, 0.0, -0.1, 0.0],
        [-0.4, -0.6, -0.05, -0.6],
        [0.05, 0.6, 0.4, -0.6],
        [0.4, 0.6, 0.05, -0.6],
        [0.5, 0.6, 0.9, 0.6],
        [0.7, 0.6, 0.7, -0.6],
    ];
    let [w, h] = [150.0, 112.0];
    let aspect = if aspect.is_finite() { aspect.clamp(0.2, 5.0) } else { 3.0 };
    let long = aspect.hypot(1.0);
    // A corner is at most 1 from the middle, which is 3 before the camera.
    let at = |x: f64, y: f64| {
        let p = camera_from_region * DVec3::new(x * aspect / long, y / long, 0.0) + DVec3::Z * 3.0;
        [w / 2.0 + 150.0 * p.x / p.z, h / 2.0 + 150.0 * p.y / p.z]
    };
    let mut canvas = Canvas::new([w, h]);
    canvas.rect([0.0, 0.0, w, h], "#f4f4f4", "");
    canvas.polygon(&[at(-1.0, 1.0), at(1.0, 1.0), at(1.0, -1.0), at(-1.0, -1.0)], "#cfe3f1", INK);
    STROKES.iter().for_each(|[a, b, c, d]| canvas.line(&[at(*a, *b), at(*c, *d)], BLUE, 2.0));
    canvas.finish(said)
}
