//! Configurations and kept captures come back as they were written, whatever they hold.

use diorama_data::photo;
use diorama_geom::capture::Frame;
use diorama_geom::glam::DVec3;
use diorama_geom::transform::rotation_from_axis_angle;
use diorama_geom::{Camera, Capture, ImageU8, Pose, SceneBox};
use diorama_pipelines::object::config::{Config, Method};
use diorama_pipelines::run::metrics::{Row, read_rows};
use diorama_pipelines::run::{RunFolder, kept_capture, summary};
use proptest::prelude::*;

fn method() -> impl Strategy<Value = Method> {
    prop::sample::select(vec![Method::Ngp, Method::Nerf, Method::Mlp, Method::Baseline])
}

/// A key with a value that it takes.
fn setting() -> impl Strategy<Value = (&'static str, String)> {
    let number = |keys: &'static [&'static str], to: f32| (prop::sample::select(keys), 0.0..to).prop_map(|(k, v)| (k, v.to_string()));
    prop_oneof![
        number(&["optim.rate", "optim.final_scale", "optim.warmup", "loss.alpha", "loss.distortion", "loss.depth"], 1.0),
        number(&["sampling.stop", "sampling.min_alpha", "sampling.near", "camera.rate", "run.save_every_seconds"], 90.0),
        (prop::sample::select(vec!["run.steps", "run.log_every", "sampling.samples", "data.memory_budget"]), 2..i64::MAX)
            .prop_map(|(k, v)| (k, v.to_string())),
        (prop::sample::select(vec!["camera.refine", "sampling.error_map", "data.skip_broken"]), any::<bool>())
            .prop_map(|(k, v)| (k, v.to_string())),
        prop::sample::select(vec!["loss.distortion", "loss.depth", "optim.table_decay"]).prop_map(|k| (k, "auto".to_string())),
        ".{1,20}".prop_map(|v| ("data.path", v)),
    ]
}

fn config(cases: u32) -> ProptestConfig {
    ProptestConfig { cases, failure_persistence: None, ..ProptestConfig::default() }
}

proptest! {
    #![proptest_config(config(200))]

    #[test]
    fn configurations(method in method(), settings in prop::collection::vec(setting(), 0..6)) {
        let mut c = Config::new(method, "photographs".into());
        for (key, value) in &settings {
            c.set(key, value).unwrap();
            let kept = c.values().into_iter().find(|(k, _)| k == key).unwrap().1;
            prop_assert!(kept == *value || kept.parse::<f32>().ok() == value.parse::<f32>().ok(), "{key}: {kept} is not {value}");
        }
        let text = c.to_toml();
        let read = Config::from_toml(&text).unwrap();
        prop_assert_eq!(&read, &c);
        prop_assert_eq!(read.to_toml(), text);
    }

    #[test]
    fn keys_that_do_not_exist_are_refused_and_one_that_does_is_named(key in "[a-z]{1,8}(\\.[a-z]{1,8})?") {
        let mut c = Config::new(Method::Ngp, "x".into());
        let known: Vec<String> = c.values().into_iter().map(|v| v.0).collect();
        prop_assume!(!known.iter().any(|k| *k == key || k.starts_with(&format!("{key}."))));
        let told = c.set(&key, "1").unwrap_err().to_string();
        let named = told.rsplit(' ').next().unwrap().trim_end_matches('?').to_string();
        prop_assert!(known.contains(&named), "{told}");
    }
}

proptest! {
    #![proptest_config(config(16))]

    #[test]
    fn kept_captures(turns in prop::collection::vec(prop::array::uniform3(-3.0..3.0f64), 3..5), name in "[a-zü ]{1,8}") {
        let dir = tempfile::tempdir().unwrap();
        let (data, run) = (dir.path().join(name.trim()).join("data"), dir.path().join("run"));
        std::fs::create_dir_all(&data).unwrap();
        std::fs::create_dir_all(&run).unwrap();
        let frame = |(i, turn): (usize, &[f64; 3])| {
            let image = data.join(format!("{i}.png"));
            photo::save_png(&image, &ImageU8 { width: 1, height: 1, channels: 3, data: vec![0; 3] }).unwrap();
            let pose = Pose { rotation: rotation_from_axis_angle(DVec3::from_array(*turn)), translation: DVec3::from_array(*turn) };
            Frame::new(format!("{i}"), image, Camera::pinhole(1, 1, 1.0), pose)
        };
        let capture =
            Capture::new(turns.iter().enumerate().map(frame).collect(), SceneBox { center: DVec3::ZERO, half: 1.0, aabb_scale: 2 });
        kept_capture::write(&run, &data, &capture).unwrap();
        prop_assert_eq!(&kept_capture::read(&run, None, &data).unwrap(), &capture);
        // The photographs moved.
        let moved = dir.path().join("moved");
        std::fs::rename(&data, &moved).unwrap();
        let read = kept_capture::read(&run, Some(&moved), &data).unwrap();
        prop_assert!(read.frames.iter().zip(&capture.frames).all(|(a, b)| a.image.is_file() && a.world_from_camera == b.world_from_camera));
    }

    #[test]
    fn metrics_and_summaries(steps in prop::collection::btree_set(0u64..1000, 1..20), loss in 0.0..9.0f64, peak in any::<u32>(), cut in 0u64..1000) {
        let dir = tempfile::tempdir().unwrap();
        let run = dir.path().join("run");
        let mut folder = RunFolder::create(&run, false).unwrap();
        let row = |s: &u64| Row { step: *s, seconds: loss * *s as f64, figures: [("loss".to_string(), loss.into())].into_iter().collect() };
        let rows: Vec<Row> = steps.iter().map(row).collect();
        std::fs::write(run.join("metrics.jsonl"), rows.iter().map(Row::line).collect::<String>()).unwrap();
        prop_assert_eq!(&read_rows(&run), &rows);
        folder.cut_metrics(cut).unwrap();
        prop_assert_eq!(read_rows(&run), rows.into_iter().filter(|r| r.step <= cut).collect::<Vec<_>>());
        let figures = serde_json::json!({ "steps": steps.len(), "peak_memory_bytes": peak });
        folder.write_summary(&figures).unwrap();
        prop_assert_eq!(summary::read::<serde_json::Value>(&run).unwrap(), Some(figures));
    }
}
