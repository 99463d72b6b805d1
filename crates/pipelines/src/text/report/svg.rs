//! Marks on a canvas, as SVG that stands in a page.

use crate::run::html::escaped;
use diorama_data::plot;

/// Colors that differ in lightness and for all kinds of color vision (Okabe and Ito 2008).
pub const BLUE: &str = "#0072b2";
pub const ORANGE: &str = "#e69f00";
pub const GREEN: &str = "#009e73";
pub const VERMILION: &str = "#d55e00";
pub const YELLOW: &str = "#f0e442";
/// Of letters and axes, and of the lines behind marks.
pub const INK: &str = "#222";
pub const GRID: &str = "#ddd";

/// What of a text stands at its place.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Anchor {
    Start,
    Middle,
    End,
}

/// A drawing of a width and a height in CSS pixels.
pub struct Canvas {
    size: [f64; 2],
    body: String,
}

/// Points as SVG's attribute has them.
fn joined(points: &[[f64; 2]]) -> String {
    points.iter().map(|p| format!("{:.1},{:.1}", p[0], p[1])).collect::<Vec<_>>().join(" ")
}

impl Canvas {
    pub fn new(size: [f64; 2]) -> Canvas {
        Canvas { size, body: String::new() }
    }

    /// A rectangle of left, top, width and height; what it says when it is pointed at.
    pub fn rect(&mut self, [x, y, w, h]: [f64; 4], fill: &str, said: &str) {
        let title = if said.is_empty() { String::new() } else { format!("<title>{}</title>", escaped(said)) };
        self.body += &format!("<rect x=\"{x:.1}\" y=\"{y:.1}\" width=\"{w:.1}\" height=\"{h:.1}\" fill=\"{fill}\">{title}</rect>\n");
    }

    pub fn line(&mut self, points: &[[f64; 2]], stroke: &str, width: f64) {
        let points = joined(points);
        self.body += &format!("<polyline fill=\"none\" stroke=\"{stroke}\" stroke-width=\"{width}\" points=\"{points}\"/>\n");
    }

    pub fn polygon(&mut self, points: &[[f64; 2]], fill: &str, stroke: &str) {
        self.body += &format!("<polygon fill=\"{fill}\" stroke=\"{stroke}\" points=\"{}\"/>\n", joined(points));
    }

    pub fn dot(&mut self, [x, y]: [f64; 2], radius: f64, fill: &str) {
        self.body += &format!("<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"{radius}\" fill=\"{fill}\"/>\n");
    }

    /// A line of text whose middle is at a height.
    pub fn text(&mut self, [x, y]: [f64; 2], anchor: Anchor, text: &str) {
        self.body += &format!("<text x=\"{x:.1}\" y=\"{:.1}\"{}>{}</text>\n", y + 4.0, anchored(anchor), escaped(text));
    }

    /// A text in the middle of a place that reads upward.
    pub fn upward(&mut self, [x, y]: [f64; 2], text: &str) {
        let turn = format!("transform=\"rotate(-90 {x:.1} {y:.1})\"");
        self.body += &format!("<text x=\"{x:.1}\" y=\"{:.1}\" text-anchor=\"middle\" {turn}>{}</text>\n", y + 4.0, escaped(text));
    }

    /// The drawing; `said` tells what it shows to those who do not see it.
    pub fn finish(self, said: &str) -> String {
        let ([w, h], said, body) = (self.size, escaped(said), self.body);
        format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {w:.0} {h:.0}\" width=\"{w:.0}\" height=\"{h:.0}\" role=\"img\" \
aria-label=\"{said}\" font-family=\"sans-serif\" font-size=\"11\" fill=\"{INK}\">\n{body}</svg>\n"
        )
    }
}

fn anchored(anchor: Anchor) -> &'static str {
    match anchor {
        Anchor::Start => "",
        Anchor::Middle => " text-anchor=\"middle\"",
        Anchor::End => " text-anchor=\"end\"",
    }
}

/// Values along an axis, and the pixels that they are at.
#[derive(Clone, Debug, PartialEq)]
pub struct Axis {
    pub values: [f64; 2],
    pub pixels: [f64; 2],
    pub ticks: Vec<(f64, String)>,
    /// What it measures, with the unit.
    pub name: String,
}

impl Axis {
    /// An axis with about `n` round values; one value alone gets room on both sides.
    pub fn new([from, to]: [f64; 2], pixels: [f64; 2], n: f64, name: &str) -> Axis {
        let [from, to] = if to - from < 1e-9 { [from - 0.5, to + 0.5] } else { [from, to] };
        let step = plot::nice_step(to - from, n);
        let first = (from / step - 1e-9).ceil();
        let count = ((to / step + 1e-9).floor() - first).max(0.0) as usize;
        let ticks = (0..=count).map(|k| (first + k as f64) * step).map(|v| (v, plot::label(v, step))).collect();
        Axis { values: [from, to], pixels, ticks, name: name.into() }
    }

    /// The same with other marks.
    pub fn with_ticks(self, ticks: Vec<(f64, String)>) -> Axis {
        Axis { ticks, ..self }
    }

    /// The pixel of a value.
    pub fn at(&self, v: f64) -> f64 {
        let [[from, to], [a, b]] = [self.values, self.pixels];
        a + (v - from) / (to - from) * (b - a)
    }
}

/// Draws axes along the left and the bottom, with a line behind the marks at each tick of the upright one.
pub fn axes(canvas: &mut Canvas, x: &Axis, y: &Axis) {
    let ([left, right], [bottom, top]) = (x.pixels, y.pixels);
    for (v, text) in &y.ticks {
        canvas.line(&[[left, y.at(*v)], [right, y.at(*v)]], GRID, 1.0);
        canvas.text([left - 6.0, y.at(*v)], Anchor::End, text);
    }
    for (v, text) in &x.ticks {
        canvas.line(&[[x.at(*v), bottom], [x.at(*v), bottom + 4.0]], INK, 1.0);
        canvas.text([x.at(*v), bottom + 12.0], Anchor::Middle, text);
    }
    canvas.line(&[[left, top], [left, bottom], [right, bottom]], INK, 1.0);
    canvas.text([(left + right) / 2.0, bottom + 28.0], Anchor::Middle, &x.name);
    canvas.upward([left - 42.0, (top + bottom) / 2.0], &y.name);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn axes_have_round_ticks_within_them() {
        let axis = Axis::new([0.0, 23.0], [100.0, 330.0], 5.0, "dB");
        assert_eq!(axis.ticks.iter().map(|t| &t.1[..]).collect::<Vec<_>>(), ["0", "5", "10", "15", "20"]);
        assert_eq!((axis.at(0.0), axis.at(23.0), axis.at(11.5)), (100.0, 330.0, 215.0));
        let one = Axis::new([7.0, 7.0], [0.0, 10.0], 4.0, "");
        assert_eq!((one.values, one.at(7.0)), ([6.5, 7.5], 5.0));
        assert!(one.ticks.iter().any(|t| t.0 == 7.0) && one.ticks.len() < 12);
        // Ends that are round themselves have ticks in spite of rounding.
        let ends = Axis::new([0.0, 0.3], [0.0, 1.0], 3.0, "");
        assert_eq!(ends.ticks.iter().map(|t| &t.1[..]).collect::<Vec<_>>(), ["0.0", "0.1", "0.2", "0.3"]);
    }

    #[test]
    fn texts_are_escaped_and_drawings_say_what_they_show() {
        let mut canvas = Canvas::new([10.0, 20.0]);
        canvas.text([0.0, 0.0], Anchor::Middle, "<script>");
        canvas.upward([0.0, 0.0], "a&b");
        canvas.rect([0.0; 4], BLUE, "\"x\"");
        let svg = canvas.finish("a \"heat map\"");
        assert!(svg.contains("&lt;script&gt;") && svg.contains("a&amp;b") && svg.contains("<title>&quot;x&quot;</title>"));
        assert!(svg.contains("aria-label=\"a &quot;heat map&quot;\"") && !svg.contains("<script>"));
    }
}
