//! `diorama prepare`

use super::{INTERRUPT, Outcome, use_threads, watch_interrupts};
use crate::arguments::PrepareArgs;
use diorama_data::split::SplitRule;
use diorama_data::video::Choice;
use diorama_pipelines::object::prepare::{self, Finish, PrepareOptions, Sfm};
use diorama_pipelines::{PipelineError, Result};
use std::time::{Duration, Instant};

pub fn run(a: &PrepareArgs) -> Result<Outcome> {
    use_threads(a.threads)?;
    let usage = |e: String| PipelineError::Usage(format!("--{e}"));
    let least = |flag: &str, ok: bool, what: &str| if ok { Ok(()) } else { Err(usage(format!("{flag}: must be {what}"))) };
    least("frames", a.frames >= 3, "at least 3")?;
    least("fps", a.fps.is_none_or(|f| f > 0.0 && f.is_finite()), "above 0")?;
    least("every", a.every >= 1, "at least 1")?;
    least("features", a.features >= 256, "at least 256")?;
    least("max-side", a.max_side.is_none_or(|s| s >= 64), "at least 64")?;
    least("min-registered", (0.0..=100.0).contains(&a.min_registered), "0 to 100")?;
    let sfm: Sfm = a.sfm.parse().map_err(usage)?;
    if sfm == Sfm::Colmap
        && let Some(flag) =
            [("format", &a.format), ("mask", &a.masks.mask), ("mask-meaning", &a.masks.mask_meaning)].iter().find(|f| f.1.is_some())
    {
        return Err(usage(format!("{}: is for captures that have poses; give --sfm none as well", flag.0)));
    }
    let split: Option<SplitRule> = a.split.as_deref().map(str::parse).transpose().map_err(usage)?;
    let diverse = |text: &String| {
        let n = text.strip_prefix("diverse:").and_then(|n| n.parse::<usize>().ok()).filter(|n| *n >= 3);
        n.ok_or_else(|| usage(format!("select {text}: expected diverse:N with N of at least 3")))
    };
    let finish = Finish {
        crop: a.crop.as_deref().map(str::parse).transpose().map_err(usage)?,
        diverse: a.select.as_ref().map(diverse).transpose()?,
        denoise: a.denoise,
        normalize_exposure: a.normalize_exposure,
        background: a.remove_background.parse().map_err(usage)?,
    };
    let options = PrepareOptions {
        finish,
        input: a.input.clone(),
        out: a.out.clone(),
        sfm,
        format: a.format.as_deref().map(str::parse).transpose().map_err(usage)?,
        masks: super::mask_options(&a.masks)?,
        choice: a.fps.map_or(Choice::Count(a.frames), Choice::PerSecond),
        every: a.every,
        max_side: a.max_side.unwrap_or(u32::MAX),
        matcher: a.matcher.parse().map_err(usage)?,
        features: a.features,
        lens: a.lens.to_uppercase(),
        split: split.unwrap_or(SplitRule::File),
        seed: a.seed,
        min_registered: a.min_registered,
        threads: a.threads,
        resume: a.resume,
        force: a.force,
        skip_broken: a.skip_broken,
    };
    watch_interrupts();
    let (mut last, mut stage) = (Instant::now(), String::new());
    let mut note = |text: &str| {
        // Each stage at once, counts within it every two seconds.
        let begins = text.split(':').next().unwrap_or(text);
        if begins != stage || last.elapsed() > Duration::from_secs(2) {
            (last, stage) = (Instant::now(), begins.to_string());
            eprintln!("{text}");
        }
    };
    let Some(made) = prepare::prepare(&options, &INTERRUPT, &mut note)? else {
        let sfm = if sfm == Sfm::None { " --sfm none" } else { "" };
        eprintln!("interrupted; go on with: diorama prepare {} -o {}{sfm} --resume", a.input.display(), a.out.display());
        return Ok(Outcome::Interrupted);
    };
    if a.json {
        println!("{}", serde_json::to_string(&made).expect("plain values"));
        return Ok(Outcome::Done);
    }
    println!(
        "{}: {} of {} photographs have poses, {} points, {} held out, scene {} times the inner cube{}",
        made.folder.display(),
        made.registered,
        made.images,
        made.points,
        made.held_out,
        made.aabb_scale,
        if made.floor { ", floor level" } else { "" }
    );
    if !made.lost.is_empty() {
        println!("without a pose: {}", made.lost.join(", "));
    }
    if !made.broken.is_empty() {
        println!("broken, left out: {}", made.broken.join(", "));
    }
    let f = &made.finished;
    if f.left_out > 0 {
        println!("left out: {} photographs that differ little from others", f.left_out);
    }
    if let Some([dark, bright]) = f.exposure_stops {
        println!("exposures made equal: they were {dark:+.2} to {bright:+.2} stops apart from the middle");
    }
    if let Some(sigma) = f.noise {
        println!("noise removed: {sigma:.1} of 255 in the middle photograph");
    }
    if let Some(share) = f.foreground {
        println!("background removed: {:.0} % of the pixels are left", 100.0 * share);
    }
    println!("look at: {}", made.sheet.display());
    println!("next: diorama train {} -o runs/{}", made.folder.display(), made.folder.file_name().unwrap_or_default().to_string_lossy());
    Ok(Outcome::Done)
}
