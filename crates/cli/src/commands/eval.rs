//! `diorama eval`

use super::{Outcome, use_threads};
use crate::arguments::EvalArgs;
use diorama_data::{DataError, photo};
use diorama_geom::ImageU8;
use diorama_geom::capture::Split;
use diorama_pipelines::object::{device, evaluate, run_folder};
use diorama_pipelines::{PipelineError, Result};

pub fn run(a: &EvalArgs) -> Result<Outcome> {
    use_threads(a.threads)?;
    let split = match &a.on[..] {
        "train" => Split::Train,
        "val" => Split::Val,
        "test" => Split::Test,
        other => return Err(PipelineError::Usage(format!("--on {other}: expected train, val or test"))),
    };
    let quality = a.quality.parse().map_err(|e| PipelineError::Usage(format!("--{e}")))?;
    let (mut model, notes) = run_folder::load_model(&a.run)?;
    device::accelerate(&mut model, &a.device)?;
    notes.iter().for_each(|n| eprintln!("note: {n}"));
    let folder = a.run.join("eval");
    if a.save_images {
        std::fs::create_dir_all(&folder).map_err(DataError::io(&folder, "create"))?;
    }
    let report = evaluate::evaluate(&model, split, quality, &mut |name, v| {
        eprintln!("{name}: psnr {:.2} ssim {:.3}", v.scores.psnr, v.scores.ssim);
        if a.save_images {
            let (r, p) = (v.view.rgb.to_u8(), v.photo.to_u8());
            let rows = r.data.chunks_exact(r.width * 3).zip(p.data.chunks_exact(p.width * 3));
            let data = rows.flat_map(|(a, b)| [a, b].concat()).collect();
            let both = ImageU8 { width: r.width + p.width, height: r.height, channels: 3, data };
            photo::save_png(&folder.join(format!("{}.png", name.replace(['/', '\\'], "_"))), &both)?;
        }
        Ok(())
    })?;
    if a.json {
        println!("{}", serde_json::to_string(&report).expect("a report is JSON"));
    } else {
        println!(
            "{} views: psnr {:.2} dB (worst {:.2}, affine {:.2}), ssim {:.4}, mse {:.5}",
            report.views, report.psnr, report.psnr_min, report.psnr_affine, report.ssim, report.mse
        );
        if model.is_linear() {
            println!("scored in {}: the photographs hold linear light", report.scored_in);
        }
        if let Some(p) = report.psnr_mean_image {
            println!("the mean training image in place of renders: {p:.2} dB");
        }
    }
    Ok(Outcome::Done)
}
