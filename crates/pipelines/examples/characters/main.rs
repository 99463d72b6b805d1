//! Trains a network to read digits and capitals in the fonts of this machine, and tests it on font families that training never saw.
//!
//! `cargo run --release -p diorama-pipelines --example characters -- [FOLDER] [--short]`; Ctrl-C saves, and the same command continues.

mod fonts;

use diorama_data::{checkpoint, photo};
use diorama_geom::{Image, rng::Rng};
use diorama_nets::layers::Init;
use diorama_nets::modules::{ResNet, ResNetSettings};
use diorama_nets::train::augment::{Augmentation, Draws};
use diorama_nets::train::{self, Ema, Gradients, Group, Loader, LoaderSettings, Optimizer, Rule, SampleKey, Schedule};
use diorama_nets::{Device, Mode, OpError, on_pool, ops, read_values};
use fonts::{Family, SIDE, in_color};
use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::time::Instant;

type Result<T> = std::result::Result<T, Box<dyn std::error::Error>>;

const CLASSES: &str = "0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZ";
static STOP: AtomicBool = AtomicBool::new(false);

fn main() -> ExitCode {
    run().unwrap_or_else(|e| {
        eprintln!("characters: {e}");
        ExitCode::from(2)
    })
}

fn run() -> Result<ExitCode> {
    let (flags, folders): (Vec<String>, Vec<String>) = std::env::args().skip(1).partition(|a| a == "--short");
    let out = folders.first().map_or_else(|| std::env::temp_dir().join("diorama-characters"), PathBuf::from);
    std::fs::create_dir_all(&out)?;
    let start = Instant::now();

    // A hash of the name assigns about a fifth of the families to the test.
    let hash = |name: &str| name.bytes().fold(0, |h, b| Rng::new(h, b as u64).key());
    let (held_out, seen): (Vec<Family>, Vec<Family>) = fonts::installed(CLASSES).into_iter().partition(|f| hash(&f.name) % 5 == 0);
    if seen.len() < 20 || held_out.len() < 4 {
        let found = seen.len() + held_out.len();
        return Err(format!("found {found} font families with digits and capitals, about 30 are needed; install more fonts").into());
    }
    let faces = |families: &[Family]| families.iter().map(|f| f.faces.len()).sum::<usize>();
    println!("{} families ({} faces) to learn from, {} ({}) held out", seen.len(), faces(&seen), held_out.len(), faces(&held_out));

    let steps = if flags.is_empty() { 2000 } else { 100 };
    let size = ResNetSettings { blocks: [1; 4], bottleneck: false, width: 32, classes: Some(CLASSES.len()) };
    let net = ResNet::new(&mut Init::new(1, &Device::flex()), size);
    let kept = Group::of(|name| name.contains("bn") || name.ends_with("bias")).weight_decay(0.0);
    let mut optimizer = Optimizer::new(&net, Rule::ADAM_W, 2e-3, 0.05, &[kept]);
    let mut average = Ema::new(&net, 0.998);
    let names: Vec<&str> = held_out.iter().map(|f| &f.name[..]).collect();
    let metadata = HashMap::from([("held out".to_string(), names.join("; "))]);
    if checkpoint::exists(&out) {
        let saved = checkpoint::load(&out)?.0;
        if saved.metadata.get("held out") != metadata.get("held out") {
            return Err(format!("{} contains a run with other fonts; choose another folder", out.display()).into());
        }
        train::resume(&net, &mut optimizer, Some(&mut average), &saved.into_arrays())?;
        println!("continuing from step {}", optimizer.steps());
    }
    ctrlc::set_handler(|| STOP.store(true, Relaxed))?;

    let items = seen.len() * CLASSES.len();
    let settings = LoaderSettings { seed: 1, items, batch: 128, shuffle: true, workers: 2, ahead: 2 };
    let mut loader = Loader::start(settings, optimizer.steps(), move |key| sample(&seen, key));
    let schedule = Schedule::cosine(steps / 20, steps);
    while optimizer.steps() < steps {
        let (images, classes): (Vec<Image>, Vec<i64>) = loader.next_batch()?.into_iter().unzip();
        let value = on_pool(|| {
            let logits = net.classify(train::stack(&images, &Device::flex())?, Mode::Train)?;
            let loss = ops::cross_entropy(logits, &classes, 0.1)?;
            let value = read_values(loss.clone())[0];
            let mut gradients = Gradients::take(&net, loss.backward());
            gradients.clip_norm(2.0);
            optimizer.step(&net, gradients, schedule.scale(optimizer.steps()));
            average.update(&net);
            Ok::<f32, OpError>(value)
        })?;
        let (step, stopped) = (optimizer.steps(), STOP.load(Relaxed));
        if step == 1 {
            save_sheet(&out.join("samples.png"), &images)?;
        }
        if step % 250 == 0 || step == steps || stopped {
            println!("step {step} of {steps}, {:.0} s: loss {value:.3}", start.elapsed().as_secs_f64());
            checkpoint::save_arrays(&out, &train::saved(&net, &optimizer, Some(&average)), metadata.clone())?;
        }
        if stopped {
            return Ok(ExitCode::from(130));
        }
    }
    average.swap(&net);
    let right = judge(&net, &held_out, &out)?;
    println!("{:.2} % of their characters after {:.0} s", 100.0 * right, start.elapsed().as_secs_f64());
    Ok(if right > 0.5 { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// A training image: a character of a family in a random face, augmented.
fn sample(families: &[Family], key: &SampleKey) -> (Image, i64) {
    let (faces, class) = (&families[key.item / CLASSES.len()].faces, key.item % CLASSES.len());
    let face = &faces[Draws::new(key.rng).below(faces.len())];
    let shape = Augmentation { shift_px: 3, rotation: 0.12, scale: 0.12, shear: 0.15, ..Augmentation::default() };
    let changes = Augmentation { contrast: 0.4, brightness: 0.1, negative: true, blur_px: 1.2, noise: 0.1, ..shape };
    (changes.apply(&in_color(&face[class]), Rng::new(key.rng.bits(0), 1)), class as i64)
}

/// Share of the families' characters that is read correctly; prints it by family, and the five most frequent mistakes.
fn judge(net: &ResNet, families: &[Family], out: &Path) -> Result<f64> {
    let (mut shares, mut confused, mut mistakes) = (Vec::new(), BTreeMap::<_, usize>::new(), Vec::new());
    for family in families {
        let before = mistakes.len();
        for face in &family.faces {
            let face: Vec<Image> = face.iter().map(in_color).collect();
            let logits = read_values(net.classify(train::stack(&face, &Device::flex())?, Mode::Eval)?);
            for (class, row) in logits.chunks(CLASSES.len()).enumerate() {
                let read = (0..row.len()).max_by(|a, b| row[*a].total_cmp(&row[*b])).unwrap_or(0);
                if read != class {
                    *confused.entry((class, read)).or_default() += 1;
                    // Beside it, in the same face, the character that was read.
                    mistakes.extend([face[class].clone(), face[read].clone()]);
                }
            }
        }
        let (n, wrong) = (family.faces.len() * CLASSES.len(), (mistakes.len() - before) / 2);
        shares.push((1.0 - wrong as f64 / n as f64, n, &family.name));
    }
    save_sheet(&out.join("mistakes.png"), &mistakes)?;
    shares.sort_by(|a, b| a.0.total_cmp(&b.0));
    shares.iter().for_each(|(share, n, name)| println!("{:6.2} % of {n:5} {name}", 100.0 * share));
    let mut pairs: Vec<_> = confused.into_iter().collect();
    pairs.sort_by_key(|(_, n)| std::cmp::Reverse(*n));
    for ((class, read), n) in pairs.iter().take(5) {
        println!("{} read as {}: {n} times", &CLASSES[*class..=*class], &CLASSES[*read..=*read]);
    }
    println!("{:.2} % as the mean over families", 100.0 * shares.iter().map(|s| s.0).sum::<f64>() / shares.len() as f64);
    Ok(1.0 - mistakes.len() as f64 / 2.0 / shares.iter().map(|s| s.1).sum::<usize>() as f64)
}

/// Images side by side, 32 in a row.
fn save_sheet(path: &Path, images: &[Image]) -> Result<()> {
    let mut sheet = Image::zeros(32 * SIDE, images.len().div_ceil(32).max(1) * SIDE, 3);
    for (i, y) in (0..images.len()).flat_map(|i| (0..SIDE).map(move |y| (i, y))) {
        let to = ((i / 32 * SIDE + y) * sheet.width + i % 32 * SIDE) * 3;
        sheet.data[to..to + SIDE * 3].copy_from_slice(&images[i].data[y * SIDE * 3..(y + 1) * SIDE * 3]);
    }
    Ok(photo::save_png(path, &sheet.to_u8())?)
}
