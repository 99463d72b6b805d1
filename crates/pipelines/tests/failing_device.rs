//! A device that fails while it draws: the result where it was named, said once where it was not.

use diorama_engine::renderers::supervised::{Supervised, Unserved};
use diorama_engine::renderers::volume::{Accelerator, Quality, Traced};
use diorama_engine::samplers::RayBatch;
use diorama_engine::samplers::placement::Placement;
use diorama_geom::capture::Split;
use diorama_pipelines::PipelineError;
use diorama_pipelines::object::config::{Config, Method};
use diorama_pipelines::object::export::{self, ExportOptions, Format, Size};
use diorama_pipelines::object::model::ObjectModel;
use diorama_pipelines::object::points::{self, PointFormat, PointOptions, Region};
use diorama_pipelines::object::render::{self, Layer, PathKind, RenderOptions};
use diorama_pipelines::object::{evaluate, quickstart, recipe};
use std::path::Path;
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex};

struct Broken;

impl Accelerator for Broken {
    fn trace(&self, _: &RayBatch, _: &Placement, _: Option<u32>) -> Result<(Traced, Option<Vec<f32>>), Unserved> {
        Err(Unserved::Failed("device fake: unplugged".into()))
    }
    fn density(&self, _: &[f32]) -> Result<Vec<f32>, Unserved> {
        Err(Unserved::Failed("device fake: unplugged".into()))
    }
    fn color(&self, _: &[f32], _: &[f32]) -> Result<Vec<f32>, Unserved> {
        Err(Unserved::Failed("device fake: unplugged".into()))
    }
    fn rays(&self) -> usize {
        512
    }
}

fn model(dir: &Path, named: bool) -> (ObjectModel, Arc<Mutex<Vec<String>>>) {
    quickstart::write_capture(dir, 8, 24).unwrap();
    let mut c = Config::new(Method::Ngp, dir.into());
    c.set("field.log2_size", "10").unwrap();
    c.set("sampling.occupancy_resolution", "16").unwrap();
    let mut m = ObjectModel::new(c.clone(), recipe::load_capture(&c).unwrap(), true).unwrap();
    let said = Arc::new(Mutex::new(Vec::new()));
    let to = said.clone();
    let say = Box::new(move |text: &str| to.lock().unwrap().push(text.to_string()));
    m.accelerator = Some(Supervised::new(Box::new(Broken), "fake", named, say));
    (m, said)
}

fn film(m: &ObjectModel, file: &Path) -> diorama_pipelines::Result<(usize, bool)> {
    let options = RenderOptions {
        path: PathKind::Orbit,
        frames: Some(2),
        size: Some((16, 16)),
        fov: None,
        layers: vec![Layer::Rgb],
        images: None,
        video: Some(file.into()),
        fps: None,
        clip: None,
        quality: Quality::Fast,
        depth: Default::default(),
        scale: None,
    };
    render::render(m, &options, &AtomicBool::new(false), &mut |_, _| {})
}

fn mesh(m: &ObjectModel, file: &Path) -> diorama_pipelines::Result<export::Exported> {
    let options = ExportOptions {
        format: Format::Ply,
        out: file.into(),
        method: Default::default(),
        resolution: 16,
        level: Some(0.01),
        faces: None,
        texture: None,
        normal_map: false,
        watertight: false,
        size: Size::Scaled(1.0),
        unit_m: 1.0,
        clip: None,
        floaters: 0.0,
        keep_unseen: true,
    };
    export::export(m, &options, &mut |_| {}, &mut |_, _, _| {})
}

fn cloud(m: &ObjectModel, file: &Path) -> diorama_pipelines::Result<points::ExportedPoints> {
    let size = Size::Scaled(1.0);
    let options = PointOptions { format: PointFormat::Ply, out: file.into(), points: 9, region: Region::Everything, size, unit_m: 1.0 };
    points::export(m, &options, &mut |_, _, _| {})
}

#[test]
fn with_a_named_device_the_failure_is_the_result_and_nothing_is_written() {
    let dir = tempfile::tempdir().unwrap();
    let (m, said) = model(dir.path(), true);
    let failed = |e: PipelineError| {
        assert!(e.kind() == "device" && !e.is_input() && e.to_string().contains("unplugged"), "{e}");
    };
    failed(evaluate::evaluate(&m, Split::Test, Quality::Full, &mut |_, _| Ok(())).unwrap_err());
    let (video, ply) = (dir.path().join("a.mp4"), dir.path().join("a.ply"));
    failed(film(&m, &video).unwrap_err());
    failed(mesh(&m, &ply).unwrap_err());
    failed(cloud(&m, &ply).unwrap_err());
    assert!(!video.exists() && !ply.exists());
    assert!(said.lock().unwrap().is_empty(), "the error itself says it");
}

#[test]
fn without_one_the_cpu_goes_on_and_it_is_said_once() {
    let dir = tempfile::tempdir().unwrap();
    let (m, said) = model(dir.path(), false);
    let report = evaluate::evaluate(&m, Split::Test, Quality::Full, &mut |_, _| Ok(())).unwrap();
    assert!(report.psnr > 3.0 && report.device == "cpu", "{report:?}");
    assert_eq!(film(&m, &dir.path().join("a.mp4")).unwrap(), (2, false));
    assert!(mesh(&m, &dir.path().join("a.ply")).unwrap().vertices > 0);
    assert_eq!(*said.lock().unwrap(), ["device fake: unplugged; the CPU goes on"]);
}
