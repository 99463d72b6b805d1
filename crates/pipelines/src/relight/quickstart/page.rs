//! The report page of a quickstart: one HTML file beside the files that it shows.

use super::Made;
use crate::run::html::escaped;
use std::path::Path;

const STYLE: &str = "body{font:16px sans-serif;max-width:60em;margin:2em auto;padding:0 1em}\
img{max-width:100%;image-rendering:auto;width:100%}td,th{padding:.2em 1em;text-align:left}pre{background:#eee;padding:1em;overflow:auto}";

/// The page.
pub fn html(m: &Made) -> String {
    let row = |name: &str, value: String| format!("<tr><td>{name}</td><td>{value}</td></tr>\n");
    let db = |v: f64| format!("{v:.2} dB");
    let scene = [
        row("Held-out views in a light of no photograph", db(m.scene.unseen_light_psnr)),
        row("the same from exact albedo, normals and shadow", db(m.scene.oracle_psnr)),
        row("the mean of the photographs in place of a model", db(m.scene.mean_light_psnr)),
        row("Held-out views in the lights of training", db(m.scene.seen_light_psnr)),
        row("Albedo, after a factor per channel", db(m.scene.albedo_psnr)),
        row("Normals, median error", format!("{:.1}°", m.scene.normal_median_deg)),
        row("Shadow, correlation with the true one", format!("{:.2}", m.scene.shadow_correlation)),
    ];
    let mut object = vec![row("Held-out views", db(m.object.object_psnr)), row("the same, path-traced", db(m.object.object_traced_psnr))];
    if let Some(t) = &m.object.truth {
        object.push(row("Under a light of no photograph", db(t.object_relight_psnr)));
        object.push(row("Base color, after a factor per channel", db(t.base_color_psnr)));
        object.push(row("Shape, mean distance over the diagonal", format!("{:.3} %", 100.0 * t.chamfer)));
    }
    let notes: String = m.notes.iter().map(|n| format!("<p>{}</p>\n", escaped(n))).collect();
    let link = |path: &Path| {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        format!("<a href=\"{name}\">{name}</a>")
    };
    format!(
        "<!doctype html>\n<html lang=\"en\"><meta charset=\"utf-8\"><title>diorama relight quickstart</title>\n<style>{STYLE}</style>\n\
<h1>diorama relight quickstart</h1>\n\
<h2>Both together</h2>\n<p>The trained chair ({chair}) in the street (the trained one is {site}) under a light that neither was photographed in, path-traced from \
<code>scene.toml</code>.</p>\n<img src=\"composed.png\" alt=\"the chair in the street\">\n{notes}\
<h2>The street</h2>\n<table>{scene}</table>\n<p>Held-out views in the light of no photograph: picture, albedo, normals, shadow and depth; the model's above, the true ones below.</p>\n\
<img src=\"pictures/layers.png\" alt=\"layers\">\n\
<h2>The chair</h2>\n<table>{object}</table>\n\
<h2>Your own photographs</h2>\n<pre>diorama relight prepare photos/ -o data/site\ndiorama relight train data/site -o runs/site\n\
diorama relight render runs/site --light dusk.hdr -o relit\ndiorama relight mesh runs/site -o site.glb\n\
diorama relight object data/chair -o chair.glb\ndiorama relight compose scene.toml -o final.exr</pre>\n</html>\n",
        chair = link(&m.glb),
        site = link(&m.site_glb),
        scene = scene.concat(),
        object = object.concat(),
    )
}
