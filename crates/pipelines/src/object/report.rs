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
