//! The report page of a quickstart: one HTML file beside the files that it shows.

use super::evaluate::Report;
use super::export::Exported;
use crate::error::Result;
use diorama_data::atomic;
use diorama_engine::train::Summary;
use std::path::Path;

/// Writes the page; `device` is what trained.
pub fn write(path: &Path, summary: &Summary, device: &str, scores: &Report, mesh: &Exported, video: bool) -> Result<()> {
    let rows: String = scores
        .per_view
        .iter()
        .map(|v| {
            format!(
                "<tr><td>{}</td><td>{:.2}</td><td>{:.4}</td><td>{}</td></tr>\n",
                v.name,
                v.psnr,
                v.ssim,
                if v.behind_fog { "behind fog" } else { "" }
            )
        })
        .collect();
    let device = if device == "cpu" { "the CPU" } else { device };
    let training = scores.training.as_ref().map_or(String::new(), |t| format!(" {} training views: {:.2} dB.", t.views, t.psnr));
    let advice = scores.advice().map_or(String::new(), |a| format!("<p><b>{a}</b></p>\n"));
    let turntable = if video { "<h2>Turntable</h2>\n<video src=\"turntable.mp4\" controls loop autoplay muted></video>\n" } else { "" };
    let html = format!(
        "<!doctype html>\n<html lang=\"en\"><meta charset=\"utf-8\"><title>diorama quickstart</title>\n\
<style>body{{font:16px sans-serif;max-width:60em;margin:2em auto;padding:0 1em}}img,video{{max-width:100%}}td,th{{padding:.2em 1em;text-align:left}}</style>\n\
<h1>diorama quickstart</h1>\n\
<p>{steps} steps in {seconds:.0} s on {device}: held-out PSNR {psnr:.2} dB, SSIM {ssim:.4} over {views} views that training never saw.{training}</p>\n{advice}\
{turntable}\
<h2>Held-out views</h2>\n<p>Above the photographs, below the renders.</p>\n<img src=\"held_out.png\" alt=\"photographs above renders\">\n\
<table><tr><th>view</th><th>PSNR, dB</th><th>SSIM</th><th></th></tr>\n{rows}</table>\n\
<h2>Mesh</h2>\n<p><a href=\"still_life.glb\">still_life.glb</a>: {faces} faces, {kib} KiB.</p>\n\
<h2>Curves</h2>\n<img src=\"curves.svg\" alt=\"PSNR and MSE against steps\">\n\
<h2>Your own photographs</h2>\n<pre>diorama train MY_CAPTURE -o runs/mine --seconds 300\ndiorama eval runs/mine --save-images\ndiorama render runs/mine --video runs/mine/orbit.mp4\ndiorama export runs/mine --format glb -o mine.glb</pre>\n</html>\n",
        steps = summary.step,
        seconds = summary.seconds,
        psnr = scores.psnr,
        ssim = scores.ssim,
        views = scores.views,
        faces = mesh.faces,
        kib = mesh.bytes >> 10,
    );
    Ok(atomic::write(path, html.as_bytes())?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::object::evaluate::{TrainingScores, ViewScore};
    use diorama_engine::train::Scalars;

    fn page(device: &str, held_out: f64) -> String {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("report.html");
        let summary = Summary { step: 9, seconds: 1.0, loss: 0.1, scalars: Scalars::default(), scores: None, interrupted: false };
        let view = |name: &str, psnr: f64, behind_fog: bool| ViewScore {
            name: name.into(),
            psnr,
            ssim: 0.9,
            mse: 0.001,
            psnr_affine: psnr,
            lpips: None,
            behind_fog,
        };
        let scores = Report {
            views: 2,
            psnr: held_out,
            ssim: 0.9,
            mse: 0.001,
            psnr_min: held_out,
            psnr_affine: held_out,
            psnr_mean_image: None,
            lpips: None,
            depth: None,
            training: Some(TrainingScores { views: 2, psnr: 30.0, ssim: 0.9 }),
            device: "cpu".into(),
            scored_in: "sRGB",
            per_view: vec![view("clear", 29.0, false), view("foggy", 20.0, true)],
        };
        let mesh = Exported {
            file: "a.glb".into(),
            vertices: 3,
            faces: 1,
            bytes: 9,
            seconds: 1.0,
            watertight: false,
            level: 1.0,
            texture: 0,
            extent_m: [1.0; 3],
            scale: 1.0,
            removed: Default::default(),
            notes: Vec::new(),
        };
        write(&file, &summary, device, &scores, &mesh, true).unwrap();
        std::fs::read_to_string(file).unwrap()
    }

    #[test]
    fn it_says_what_trained_and_marks_views_behind_fog() {
        let (cpu, gpu) = (page("cpu", 29.0), page("NVIDIA H100 (cuda)", 24.5));
        assert!(cpu.contains("on the CPU:") && !cpu.contains("below training views"));
        assert!(gpu.contains("on NVIDIA H100 (cuda):") && !gpu.contains("the CPU"));
        assert!(gpu.contains("5.5 dB below training views") && gpu.contains("fog"));
        let row = |name: &str| cpu.lines().find(|l| l.contains(name)).unwrap().contains("behind fog");
        assert!(row("foggy") && !row("clear"));
    }
}
