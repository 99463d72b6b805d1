//! The report's page.

use super::charts::{self, Series};
use super::failures::Failures;
use super::gathered::{Gathered, PoseCluster, VISIBILITY, facing, slope};
use super::svg::{BLUE, GREEN, ORANGE};
use super::{Contents, LabelledSet, pictures};
use crate::error::Result;
use crate::run::html::{self, escaped};
use crate::text::detectors::evaluation::Score;
use crate::text::synth::prior::CELLS;

const STYLE: &str = "figure{display:inline-block;margin:0 1em 1em 0;vertical-align:top;font-size:.85em}figcaption{margin:.2em 0;max-width:26em;\
overflow-wrap:anywhere}table{border-collapse:collapse;margin-bottom:1em}tr{border-top:1px solid #ddd}svg{max-width:100%;height:auto}\
pre{font-size:.85em}@media print{figure{break-inside:avoid}pre{white-space:pre-wrap}}";
/// Bins of areas, by decade of percents of the image.
const PER_DECADE: usize = 4;
/// Decades of percents that are always drawn.
const DECADES: [i32; 2] = [-1, 1];
/// Pixels of the longer side of images of a cluster and of the sheet, and images of the sheet.
const CLUSTER_PX: usize = 150;
const SAMPLE_PX: usize = 240;
const SAMPLES: usize = 12;
/// Scenes that are drawn.
const SCENES: usize = 24;

/// A page: `head` before, `foot` after the figures, both HTML.
///
/// # Errors
/// When an image of a data set cannot be read.
pub fn html(title: &str, head: &str, contents: &Contents, foot: &str) -> Result<String> {
    let mut body = format!("{head}{}", overview(contents));
    let sets: Vec<&Gathered> = contents.sets.iter().map(|s| &s.figures).chain(&contents.real).collect();
    if !sets.is_empty() {
        body += &places(&sets);
    }
    for set in &contents.sets {
        body += &poses(set)?;
    }
    if !contents.detectors.is_empty() {
        body += "<h2>Detectors</h2>\n<p>A box is right where it overlaps a word by more than half (intersection over union). Precision is the share of \
boxes that are right, recall the share of words that are found, F their harmonic mean. Words marked ### do not count.</p>\n";
        body += &contents.detectors.iter().map(failures).collect::<String>();
    }
    if !contents.fields.is_empty() {
        body += &fields(contents);
    }
    for set in &contents.sets {
        body += &samples(set)?;
    }
    Ok(html::page(title, STYLE, &(body + foot)))
}

fn figure(caption: &str, drawing: &str) -> String {
    format!("<figure>{drawing}<figcaption>{}</figcaption></figure>\n", escaped(caption))
}

fn table(head: &[&str], rows: &[Vec<String>]) -> String {
    let row = |tag: &str, cells: &[String]| {
        let cells: String = cells.iter().map(|c| format!("<{tag}>{}</{tag}>", escaped(c))).collect();
        format!("<tr>{cells}</tr>\n")
    };
    let head: Vec<String> = head.iter().map(|h| h.to_string()).collect();
    format!("<table>{}{}</table>\n", row("th", &head), rows.iter().map(|r| row("td", r)).collect::<String>())
}

/// The sets of the page and their numbers.
fn overview(contents: &Contents) -> String {
    let row = |g: &Gathered| {
        let areas = &g.prior.areas;
        let area = areas.get(areas.len() / 2).map_or("–".into(), |a| format!("{:.2} %", 100.0 * a));
        let scenes = if g.scenes > 0 { g.scenes.to_string() } else { "–".into() };
        vec![g.name.clone(), g.images.to_string(), scenes, g.words.to_string(), g.unreadable.to_string(), area]
    };
    let rows: Vec<Vec<String>> = contents.sets.iter().map(|s| &s.figures).chain(&contents.real).map(row).collect();
    if rows.is_empty() {
        return String::new();
    }
    let head = ["Labels", "Images", "Scenes", "Words", "of them ###", "Median area of a word, of the image"];
    format!("<h2>Data</h2>\n{}", table(&head, &rows))
}

/// Decades of percents that hold most areas of all sets.
fn decades(sets: &[&Gathered]) -> [i32; 2] {
    let all = || sets.iter().flat_map(|s| &s.prior.areas).map(|a| 100.0 * a).filter(|a| *a > 0.0);
    let least = all().fold(f64::INFINITY, f64::min).log10().floor();
    let most = all().fold(0.0, f64::max).log10().ceil();
    [
        if least.is_finite() { (least as i32).clamp(-4, DECADES[0]) } else { DECADES[0] },
        if most.is_finite() { (most as i32).clamp(DECADES[1], 2) } else { DECADES[1] },
    ]
}

/// Places, areas, visible shares and scripts, those of all sets side by side.
fn places(sets: &[&Gathered]) -> String {
    let decades = decades(sets);
    let each = |draw: &dyn Fn(&Gathered) -> String| sets.iter().map(|g| figure(&g.name, &draw(g))).collect::<String>();
    let heat = each(&|g| charts::heat_map(&g.prior.centers, CELLS, g.aspect, &format!("Heat map of the middles of words of {}", g.name)));
    let areas = each(&|g| {
        let percents: Vec<f64> = g.prior.areas.iter().map(|a| 100.0 * a).collect();
        let said = format!("Histogram of areas of words of {}", g.name);
        charts::histogram(
            &charts::log_bins(&percents, decades, PER_DECADE),
            charts::log_ticks(decades, PER_DECADE),
            "area of a word, % of the image",
            &said,
        )
    });
    let tenths: Vec<(f64, String)> = (0..=5).map(|k| (k as f64 * VISIBILITY as f64 / 5.0, format!("{}", 20 * k))).collect();
    let told: Vec<&&Gathered> = sets.iter().filter(|g| g.visibility.is_some()).collect();
    let visible = |g: &&&Gathered| {
        let said = format!("Histogram of visible shares of words of {}", g.name);
        figure(&g.name, &charts::histogram(g.visibility.as_deref().unwrap_or_default(), tenths.clone(), "visible part of a word, %", &said))
    };
    let visibility: String = told.iter().map(visible).collect();
    let scripts = each(&|g| {
        let (names, counts): (Vec<String>, Vec<f64>) = g.scripts.iter().map(|(n, c)| (n.clone(), *c as f64)).unzip();
        let series = [Series { name: "words", color: BLUE, values: counts }];
        charts::bars(&names, &series, (None, "words", 0), &format!("Words of {} by script", g.name))
    });
    let mut out = format!(
        "<h2>Where words are</h2>\n<p>Middles of words that are to be read, in {CELLS} × {CELLS} cells.</p>\n{heat}\
<h2>How large words are</h2>\n<p>Words that are to be read; the axis is logarithmic.</p>\n{areas}"
    );
    if !told.is_empty() {
        out += &format!("<h2>How much of them is visible</h2>\n<p>All words.</p>\n{visibility}");
    }
    out + &format!("<h2>Words by script</h2>\n{scripts}")
}

/// The clusters of a data set's poses.
fn poses(set: &LabelledSet) -> Result<String> {
    let g = &set.figures;
    let name = escaped(&g.name);
    if g.clusters.is_empty() {
        return Ok(format!("<h2>Poses: {name}</h2>\n<p>The data set tells no poses of its words.</p>\n"));
    }
    let whose = if g.are_told {
        "The clusters are those of <code>diorama text synth</code>."
    } else {
        "The data set numbers no clusters: these are 16 of its own poses, and none that <code>diorama text synth</code> knows."
    };
    let most = g.clusters.iter().map(|c| c.number).max().unwrap_or(0);
    let absent: Vec<String> = (0..most).filter(|n| g.clusters.iter().all(|c| c.number != *n)).map(|n| n.to_string()).collect();
    let absent = if absent.is_empty() { String::new() } else { format!(" None of the words is of cluster {}.", absent.join(", ")) };
    let means: Vec<([f64; 2], usize)> = g.clusters.iter().map(|c| (facing(c.mean), c.number)).collect();
    let names = ["text faces right, degrees", "text faces up, degrees"];
    let directions =
        charts::scatter(&g.normals, &means, names, &format!("Directions that words of {} face, and means of clusters", g.name));
    let numbers: Vec<String> = g.clusters.iter().map(|c| format!("cluster {}", c.number)).collect();
    let words = Series { name: "words", color: BLUE, values: g.clusters.iter().map(|c| c.words as f64).collect() };
    let counts = charts::bars(&numbers, &[words], (None, "words", 0), &format!("Words of {} by pose cluster", g.name));
    let cards = g.clusters.iter().map(|c| card(set, c)).collect::<Result<String>>()?;
    let (counts, directions) = (
        figure("Words of each cluster", &counts),
        figure("Directions that words face (dots), and the clusters' means; 0, 0 is toward the camera", &directions),
    );
    Ok(format!(
        "<h2>Poses: {name}</h2>\n<p>{whose}{absent} Each is drawn in its mean pose, beside the image whose word is closest to it.</p>\n{counts}{directions}<div>\n{cards}</div>\n"
    ))
}

fn card(set: &LabelledSet, c: &PoseCluster) -> Result<String> {
    let [right, up] = facing(c.mean);
    let drawing = charts::pose(c.mean, c.aspect, &format!("Mean pose of cluster {}", c.number));
    let (image, word) = c.example;
    let image = &set.images[image];
    let example = pictures::labelled(&set.folder, image, [&image.words[word]], CLUSTER_PX)?;
    let turned = |v: f64, [one, other]: [&str; 2]| match v.round() as i64 {
        0 => "0°".to_string(),
        n => format!("{}° {}", n.abs(), if n < 0 { other } else { one }),
    };
    let [right, up] = [turned(right, ["right", "left"]), turned(up, ["up", "down"])];
    let line = turned(slope(c.mean), ["clockwise", "counterclockwise"]);
    let caption =
        format!("Cluster {}: {} words, {} of them ###; faces {right} and {up}, line turned {line}", c.number, c.words, c.unreadable);
    Ok(figure(&caption, &format!("{drawing} {example}")))
}

fn score_series(scores: &[Score]) -> [Series; 3] {
    let of = |name, color, f: fn(&Score) -> f64| Series { name, color, values: scores.iter().map(|s| 100.0 * f(s)).collect() };
    [of("precision", BLUE, |s| s.precision), of("recall", ORANGE, |s| s.recall), of("F", GREEN, |s| s.f)]
}

/// A detector's scores on a data set.
fn failures(f: &Failures) -> String {
    let e = &f.judged.evaluation;
    let row = |name: &str, s: &Score| vec![name.to_string(), percent(s.precision), percent(s.recall), percent(s.f)];
    let rows = [row("all words", &e.instance), row("mean over scenes", &e.scene), row("all words, DetEval", &f.judged.det_eval)];
    let mut out = format!("<h3>{} on {}</h3>\n", escaped(&f.detector), escaped(&f.set));
    if !f.learned_from.is_empty() {
        out += &format!("<p>The detector has learned from {}.</p>\n", escaped(&f.learned_from));
    }
    if f.is_trained_on {
        out += "<p><b>These are the very images that it has learned from: its scores on others are lower.</b></p>\n";
    }
    out += &format!(
        "<p>{} images, {} words, {} detections, {:.1} images per second.</p>\n",
        e.images, e.labels, e.detections, f.judged.images_per_s
    );
    out += &table(&["", "Precision, %", "Recall, %", "F, %"], &rows);
    let mut scenes: Vec<_> = e.scenes.iter().collect();
    scenes.sort_by(|a, b| a.score.f.total_cmp(&b.score.f));
    let names: Vec<String> = scenes.iter().take(SCENES).map(|s| s.scene.clone()).collect();
    let scores: Vec<Score> = scenes.iter().take(SCENES).map(|s| s.score).collect();
    let caption = if scenes.len() > SCENES {
        format!("The {SCENES} weakest of {} scenes", scenes.len())
    } else {
        "By scene, means over images".into()
    };
    let axis = (Some(100.0), "%", 1);
    out += &figure(&caption, &charts::bars(&names, &score_series(&scores), axis, &format!("Scores of {} by scene", f.detector)));
    if e.clusters.is_empty() {
        return out + "<p>The data set tells no poses.</p>\n";
    }
    let names: Vec<String> = e.clusters.iter().map(|c| format!("cluster {} ({} words)", c.cluster, c.labels)).collect();
    let scores: Vec<Score> = e.clusters.iter().map(|c| c.score).collect();
    out += &figure(
        "By pose cluster",
        &charts::bars(&names, &score_series(&scores), axis, &format!("Scores of {} by pose cluster", f.detector)),
    );
    out + &weakest(f)
}

/// The weakest clusters in words, and what fills them.
fn weakest(f: &Failures) -> String {
    if f.weakest.is_empty() {
        return "<p>No cluster of five or more words is below all words together.</p>\n".into();
    }
    let numbers: Vec<String> = f.weakest.iter().map(usize::to_string).collect();
    let mut out = format!("<p>Weakest pose clusters: <b>{}</b>.", numbers.join(", "));
    out += &match &f.command {
        Some(command) => {
            let list = if command.contains(" scenes.toml ") {
                " (<code>scenes.toml</code> lists the scenes of this data set, or is the run of its only one)"
            } else {
                ""
            };
            format!(" More images of them{list}:</p>\n<pre>{}</pre>\n", escaped(command))
        }
        None => {
            " <code>diorama text synth</code> has not numbered them: judge the detector on a data set of its making to fill them.</p>\n"
                .into()
        }
    };
    out
}

fn percent(v: f64) -> String {
    format!("{:.1}", 100.0 * v)
}

/// Qualities of fields over their held-out views.
fn fields(contents: &Contents) -> String {
    let group = |f: fn(&crate::text::field::scores::ViewScore) -> Option<f64>| {
        contents
            .fields
            .iter()
            .map(|r| (r.run.clone(), r.scores.per_view.iter().filter_map(f).collect()))
            .collect::<Vec<(String, Vec<f64>)>>()
    };
    let (psnr, ssim, lpips) = (group(|v| Some(v.psnr)), group(|v| Some(v.ssim)), group(|v| v.lpips));
    let rows: Vec<Vec<String>> = contents
        .fields
        .iter()
        .map(|f| {
            let s = &f.scores;
            let lpips = f.lpips().map_or("–".into(), |v| format!("{v:.3}"));
            let miou = s.miou.map_or("–".into(), |v| format!("{v:.3}"));
            vec![f.run.clone(), s.views.to_string(), format!("{:.2}", s.psnr), format!("{:.3}", s.ssim), lpips, miou]
        })
        .collect();
    let mut out = String::from(
        "<h2>Fields</h2>\n<p>Views that training never saw. Boxes reach from the first to the third quartile, the red line is the median, whiskers end \
at the last views within 1.5 of the box's length, dots are views beyond.</p>\n",
    );
    out += &figure("PSNR, higher is better", &charts::boxes(&psnr, "PSNR, dB", "Box plots of PSNR"));
    out += &figure("SSIM, higher is better", &charts::boxes(&ssim, "SSIM", "Box plots of SSIM"));
    if lpips.iter().any(|(_, v)| !v.is_empty()) {
        out += &figure("LPIPS, lower is better", &charts::boxes(&lpips, "LPIPS", "Box plots of LPIPS"));
    }
    out + &table(&["Run", "Views", "PSNR, dB", "SSIM", "LPIPS", "mIoU of regions"], &rows)
}

/// Some images of a data set with all outlines.
fn samples(set: &LabelledSet) -> Result<String> {
    let n = SAMPLES.min(set.images.len());
    let mut out = format!(
        "<h2>Images: {}</h2>\n<p>{n} of {}. Outlines drawn through are words to be read, dashed ones (###) are not.</p>\n",
        escaped(&set.figures.name),
        set.images.len()
    );
    for k in 0..n {
        let image = &set.images[k * set.images.len() / n];
        let shown = pictures::labelled(&set.folder, image, &image.words, SAMPLE_PX)?;
        let caption = format!("{} · {}", image.image.rsplit('/').next().unwrap_or(&image.image), image.scene);
        out += &figure(caption.trim_end_matches(" · "), &shown);
    }
    Ok(out)
}
