//! Line charts as SVG and as pixels.

use diorama_geom::ImageU8;

/// Points of one line.
#[derive(Clone, Debug, PartialEq)]
pub struct Series {
    pub name: String,
    pub points: Vec<(f64, f64)>,
}

/// One set of axes.
#[derive(Clone, Debug, PartialEq)]
pub struct Chart {
    pub title: String,
    pub x: String,
    pub y: String,
    pub series: Vec<Series>,
}

const WIDTH: f64 = 640.0;
const HEIGHT: f64 = 360.0;
/// Left, right, top and bottom margin.
const MARGIN: [f64; 4] = [64.0, 16.0, 34.0, 44.0];
const COLORS: [[u8; 3]; 8] =
    [[31, 119, 180], [214, 39, 40], [44, 160, 44], [255, 127, 14], [148, 103, 189], [23, 190, 207], [140, 86, 75], [127, 127, 127]];

/// Drawing primitives that both outputs support.
enum Mark {
    Line {
        points: Vec<(f64, f64)>,
        color: [u8; 3],
        width: f64,
    },
    /// Anchor: 0 left, 0.5 middle, 1 right.
    Text {
        at: (f64, f64),
        text: String,
        anchor: f64,
        color: [u8; 3],
    },
}

/// "Nice" step so that about `n` of them span `range`.
pub fn nice_step(range: f64, n: f64) -> f64 {
    let raw = (range / n).max(1e-12);
    let power = 10f64.powf(raw.log10().floor());
    [1.0, 2.0, 5.0, 10.0].iter().map(|m| m * power).find(|s| *s >= raw).unwrap_or(10.0 * power)
}

/// A value as text, with the decimals that ticks of a `step` need.
pub fn label(v: f64, step: f64) -> String {
    if v.abs() >= 10_000.0 && step >= 1000.0 {
        return format!("{}k", (v / 1000.0).round());
    }
    let v = if v.abs() < step * 1e-6 { 0.0 } else { v };
    let decimals = (-step.log10().floor()).clamp(0.0, 6.0) as usize;
    format!("{v:.decimals$}")
}

fn marks(chart: &Chart, top: f64) -> Vec<Mark> {
    let (ink, grid) = ([40; 3], [225; 3]);
    let all: Vec<(f64, f64)> =
        chart.series.iter().flat_map(|s| &s.points).copied().filter(|p| p.0.is_finite() && p.1.is_finite()).collect();
    let title = Mark::Text { at: (WIDTH / 2.0, top + 12.0), text: chart.title.clone(), anchor: 0.5, color: ink };
    if all.is_empty() {
        let note = Mark::Text { at: (WIDTH / 2.0, top + HEIGHT / 2.0), text: "no data".into(), anchor: 0.5, color: ink };
        return vec![title, note];
    }
    let range = |f: fn(&(f64, f64)) -> f64| {
        let (lo, hi) = all.iter().map(f).fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), v| (a.min(v), b.max(v)));
        if hi - lo < 1e-12 { (lo - 0.5, hi + 0.5) } else { (lo, hi) }
    };
    let ((x0, x1), (y0, y1)) = (range(|p| p.0), range(|p| p.1));
    let pad = (y1 - y0) * 0.05;
    let (y0, y1) = (y0 - pad, y1 + pad);
    let (left, right) = (MARGIN[0], WIDTH - MARGIN[1]);
    let (up, down) = (top + MARGIN[2], top + HEIGHT - MARGIN[3]);
    let px = |x: f64| left + (x - x0) / (x1 - x0) * (right - left);
    let py = |y: f64| down - (y - y0) / (y1 - y0) * (down - up);
    let mut out = vec![title];
    let (sx, sy) = (nice_step(x1 - x0, 6.0), nice_step(y1 - y0, 5.0));
    let mut v = (y0 / sy).ceil() * sy;
    while v <= y1 {
        out.push(Mark::Line { points: vec![(left, py(v)), (right, py(v))], color: grid, width: 1.0 });
        out.push(Mark::Text { at: (left - 6.0, py(v) - 3.0), text: label(v, sy), anchor: 1.0, color: ink });
        v += sy;
    }
    let mut v = (x0 / sx).ceil() * sx;
    while v <= x1 {
        out.push(Mark::Text { at: (px(v), down + 8.0), text: label(v, sx), anchor: 0.5, color: ink });
        v += sx;
    }
    out.push(Mark::Line { points: vec![(left, up), (left, down), (right, down)], color: ink, width: 1.0 });
    out.push(Mark::Text { at: ((left + right) / 2.0, down + 26.0), text: chart.x.clone(), anchor: 0.5, color: ink });
    out.push(Mark::Text { at: (left - 56.0, up - 14.0), text: chart.y.clone(), anchor: 0.0, color: ink });
    // The names are placed where no curve ends.
    let at_the_right: Vec<f64> = all.iter().filter(|p| px(p.0) > 0.25 * left + 0.75 * right).map(|p| py(p.1)).collect();
    let end = at_the_right.iter().sum::<f64>() / at_the_right.len().max(1) as f64;
    let names = if end < 0.5 * (up + down) { down - 4.0 - 13.0 * chart.series.len() as f64 } else { up + 4.0 };
    for (i, s) in chart.series.iter().enumerate() {
        let color = COLORS[i % COLORS.len()];
        let points = s.points.iter().filter(|p| p.0.is_finite() && p.1.is_finite()).map(|p| (px(p.0), py(p.1))).collect();
        out.push(Mark::Line { points, color, width: 2.0 });
        out.push(Mark::Text { at: (right - 4.0, names + 13.0 * i as f64), text: s.name.clone(), anchor: 1.0, color });
    }
    out
}

/// Renders charts, one below the other, as SVG text.
pub fn svg(charts: &[Chart]) -> String {
    let h = HEIGHT * charts.len() as f64;
    let mut out = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {h}\" width=\"{WIDTH}\" height=\"{h}\" font-family=\"sans-serif\" font-size=\"11\">\n<rect width=\"100%\" height=\"100%\" fill=\"white\"/>\n"
    );
    for (i, c) in charts.iter().enumerate() {
        for m in marks(c, HEIGHT * i as f64) {
            match m {
                Mark::Line { points, color: [r, g, b], width } => {
                    let p: Vec<String> = points.iter().map(|p| format!("{:.1},{:.1}", p.0, p.1)).collect();
                    out += &format!(
                        "<polyline fill=\"none\" stroke=\"rgb({r},{g},{b})\" stroke-width=\"{width}\" points=\"{}\"/>\n",
                        p.join(" ")
                    );
                }
                Mark::Text { at, text, anchor, color: [r, g, b] } => {
                    let anchor = ["start", "middle", "end"][(anchor * 2.0) as usize];
                    let text = text.replace('&', "&amp;").replace('<', "&lt;");
                    out += &format!(
                        "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"{anchor}\" fill=\"rgb({r},{g},{b})\">{text}</text>\n",
                        at.0,
                        at.1 + 8.0
                    );
                }
            }
        }
    }
    out + "</svg>\n"
}

/// Renders charts, one below the other, as an image of twice the SVG's size.
pub fn raster(charts: &[Chart]) -> ImageU8 {
    let s = 2.0;
    let (w, h) = ((WIDTH * s) as usize, (HEIGHT * s) as usize * charts.len().max(1));
    let mut im = ImageU8 { width: w, height: h, channels: 3, data: vec![255; w * h * 3] };
    for (i, c) in charts.iter().enumerate() {
        for m in marks(c, HEIGHT * i as f64) {
            match m {
                Mark::Line { points, color, width } => {
                    for p in points.windows(2) {
                        line(&mut im, (p[0].0 * s, p[0].1 * s), (p[1].0 * s, p[1].1 * s), width * s, color);
                    }
                }
                Mark::Text { at, text, anchor, color } => write(&mut im, (at.0 * s, at.1 * s), &text, anchor, color),
            }
        }
    }
    im
}

/// Draws an antialiased line on `[H, W, 3]`: coverage falls off over one pixel at distance `width / 2`.
pub fn line(im: &mut ImageU8, a: (f64, f64), b: (f64, f64), width: f64, color: [u8; 3]) {
    let r = width / 2.0 + 1.0;
    let clamp = |v: f64, n: usize| v.clamp(0.0, n as f64) as usize;
    let (x0, x1) = (clamp(a.0.min(b.0) - r, im.width), clamp(a.0.max(b.0) + r + 1.0, im.width));
    let (y0, y1) = (clamp(a.1.min(b.1) - r, im.height), clamp(a.1.max(b.1) + r + 1.0, im.height));
    let (dx, dy) = (b.0 - a.0, b.1 - a.1);
    let len2 = (dx * dx + dy * dy).max(1e-12);
    for y in y0..y1 {
        for x in x0..x1 {
            let (px, py) = (x as f64 + 0.5 - a.0, y as f64 + 0.5 - a.1);
            let t = ((px * dx + py * dy) / len2).clamp(0.0, 1.0);
            let d = ((px - t * dx).powi(2) + (py - t * dy).powi(2)).sqrt();
            let cover = (width / 2.0 + 0.5 - d).clamp(0.0, 1.0);
            if cover > 0.0 {
                let at = (y * im.width + x) * 3;
                for k in 0..3 {
                    let old = im.data[at + k] as f64;
                    im.data[at + k] = (old + (color[k] as f64 - old) * cover) as u8;
                }
            }
        }
    }
}

/// A 5×7 font: one byte per row, the leftmost pixel in bit 4. Letters are drawn in upper case.
fn glyph(c: char) -> [u8; 7] {
    match c.to_ascii_uppercase() {
        '0' => [14, 17, 19, 21, 25, 17, 14],
        '1' => [4, 12, 4, 4, 4, 4, 14],
        '2' => [14, 17, 1, 2, 4, 8, 31],
        '3' => [31, 2, 4, 2, 1, 17, 14],
        '4' => [2, 6, 10, 18, 31, 2, 2],
        '5' => [31, 16, 30, 1, 1, 17, 14],
        '6' => [6, 8, 16, 30, 17, 17, 14],
        '7' => [31, 1, 2, 4, 8, 8, 8],
        '8' => [14, 17, 17, 14, 17, 17, 14],
        '9' => [14, 17, 17, 15, 1, 2, 12],
        'A' => [14, 17, 17, 31, 17, 17, 17],
        'B' => [30, 17, 17, 30, 17, 17, 30],
        'C' => [14, 17, 16, 16, 16, 17, 14],
        'D' => [30, 17, 17, 17, 17, 17, 30],
        'E' => [31, 16, 16, 30, 16, 16, 31],
        'F' => [31, 16, 16, 30, 16, 16, 16],
        'G' => [14, 17, 16, 23, 17, 17, 15],
        'H' => [17, 17, 17, 31, 17, 17, 17],
        'I' => [14, 4, 4, 4, 4, 4, 14],
        'J' => [7, 2, 2, 2, 2, 18, 12],
        'K' => [17, 18, 20, 24, 20, 18, 17],
        'L' => [16, 16, 16, 16, 16, 16, 31],
        'M' => [17, 27, 21, 21, 17, 17, 17],
        'N' => [17, 17, 25, 21, 19, 17, 17],
        'O' => [14, 17, 17, 17, 17, 17, 14],
        'P' => [30, 17, 17, 30, 16, 16, 16],
        'Q' => [14, 17, 17, 17, 21, 18, 13],
        'R' => [30, 17, 17, 30, 20, 18, 17],
        'S' => [15, 16, 16, 14, 1, 1, 30],
        'T' => [31, 4, 4, 4, 4, 4, 4],
        'U' => [17, 17, 17, 17, 17, 17, 14],
        'V' => [17, 17, 17, 17, 17, 10, 4],
        'W' => [17, 17, 17, 21, 21, 21, 10],
        'X' => [17, 17, 10, 4, 10, 17, 17],
        'Y' => [17, 17, 17, 10, 4, 4, 4],
        'Z' => [31, 1, 2, 4, 8, 16, 31],
        '.' => [0, 0, 0, 0, 0, 12, 12],
        '-' => [0, 0, 0, 31, 0, 0, 0],
        '_' => [0, 0, 0, 0, 0, 0, 31],
        '/' => [0, 1, 2, 4, 8, 16, 0],
        ':' => [0, 12, 12, 0, 12, 12, 0],
        ' ' => [0; 7],
        _ => [31, 17, 17, 17, 17, 17, 31],
    }
}

/// A line of text, black on white.
pub fn caption(text: &str) -> ImageU8 {
    let (width, height) = ((text.chars().count() * ADVANCE).max(1), 22);
    let mut im = ImageU8 { width, height, channels: 3, data: vec![255; width * height * 3] };
    write(&mut im, (0.0, 6.0), text, 0.0, [0; 3]);
    im
}

/// Edge of a glyph's dots in pixels, and distance from one glyph to the next.
const DOT: usize = 2;
const ADVANCE: usize = 6 * DOT;

fn write(im: &mut ImageU8, at: (f64, f64), text: &str, anchor: f64, color: [u8; 3]) {
    let (scale, advance) = (DOT, ADVANCE);
    let n = text.chars().count();
    let left = (at.0 - anchor * (n * advance) as f64).max(0.0) as usize;
    for (i, c) in text.chars().enumerate() {
        for (row, bits) in glyph(c).into_iter().enumerate() {
            for col in 0..5 {
                if bits >> (4 - col) & 1 == 0 {
                    continue;
                }
                for k in 0..scale * scale {
                    let (x, y) = (left + i * advance + col * scale + k % scale, at.1 as usize + row * scale + k / scale);
                    if x < im.width && y < im.height {
                        im.data[(y * im.width + x) * 3..][..3].copy_from_slice(&color);
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn chart() -> Chart {
        let points = (0..50).map(|i| (i as f64 * 10.0, 10.0 + (i as f64).sqrt())).collect();
        Chart { title: "PSNR".into(), x: "step".into(), y: "dB".into(), series: vec![Series { name: "a & b".into(), points }] }
    }

    #[test]
    fn svg_escapes_and_draws_each_series() {
        let s = svg(&[chart()]);
        assert!(s.starts_with("<svg") && s.ends_with("</svg>\n"));
        assert!(s.contains("a &amp; b") && s.matches("stroke-width=\"2\"").count() == 1);
    }

    #[test]
    fn the_image_shows_the_line_rising_to_the_right() {
        let im = raster(&[chart()]);
        let mean_row = |x0: usize, x1: usize| {
            let rows: Vec<usize> = (0..im.height).filter(|&y| (x0..x1).any(|x| im.pixel(x, y) == COLORS[0])).collect();
            rows.iter().sum::<usize>() as f64 / rows.len() as f64
        };
        assert!(mean_row(200, 260) > mean_row(900, 960) + 50.0);
    }

    #[test]
    fn empty_and_constant_charts_do_not_fail() {
        let mut c = chart();
        c.series[0].points = vec![(1.0, 5.0), (1.0, 5.0), (f64::NAN, 1.0)];
        raster(&[c.clone()]);
        c.series.clear();
        assert!(svg(&[c]).contains("no data"));
    }
}
