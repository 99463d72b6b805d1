//! A run's model: the stage that it is in, and its checkpoints.

use super::capture::{ObjectCapture, ObjectView};
use super::carving::Carving;
use super::config::Config;
use super::placement::Placement;
use super::probe::Probe;
use super::textured::{Layout, Textured};
use super::topology::Topology;
use super::traced;
use crate::error::{PipelineError, Result};
use crate::relight::light::{LightOptions, Source};
use crate::run::param_state::{self, entry};
use diorama_data::checkpoint::{self, Checkpoint, Entry};
use diorama_data::{DataError, model_file};
use diorama_engine::params::ParamSet;
use diorama_engine::train::Origin;
use diorama_geom::capture::Split;
use diorama_geom::glam::{DMat3, DVec3};
use diorama_geom::{Mesh, Model};
use diorama_kernels::ops::adam::Adam;
use diorama_mesh::clean;
use std::collections::HashMap;
use std::path::Path;

/// Parts of the surface with less than this share of the largest one's faces are dropped between the stages.
const FLOATER: f32 = 0.002;

/// What is optimized.
pub enum Stage {
    Topology(Box<Topology>),
    Textured(Box<Textured>),
}

impl Stage {
    /// Name in checkpoints.
    pub fn name(&self) -> &'static str {
        match self {
            Stage::Topology(_) => "topology",
            Stage::Textured(m) if m.surroundings.is_some() => "traced",
            Stage::Textured(_) => "textured",
        }
    }
}

/// The model of a run.
pub struct ObjectModel {
    pub config: Config,
    pub placement: Placement,
    pub stage: Stage,
    pub probe: Probe,
    pub origin: Origin,
    /// Factor of all rates: lower after something went wrong.
    pub rate_scale: f32,
    /// Added to the first distances, in cells, and how often the first stage began.
    pub bias: f32,
    pub beginnings: u32,
    /// What was mended in the file of a given light.
    pub notes: Vec<String>,
}

impl ObjectModel {
    /// An untrained model.
    ///
    /// # Errors
    /// When a given light or mesh cannot be read.
    pub fn new(config: Config, capture: &ObjectCapture) -> Result<ObjectModel> {
        let mut model = ObjectModel::empty(config, capture)?;
        if model.config.topology_steps() == 0 && !model.config.base_mesh.as_os_str().is_empty() {
            let mesh = base_mesh(&model.config.base_mesh, &model.placement)?;
            model.stage = Stage::Textured(Box::new(Textured::new(&model.config, &mesh, None)));
        } else {
            model.begin(capture);
        }
        Ok(model)
    }

    /// The model of a checkpoint.
    ///
    /// # Errors
    /// When a given light cannot be read, or the checkpoint is damaged.
    pub fn restored(config: Config, capture: &ObjectCapture, c: Checkpoint, file: &Path) -> Result<ObjectModel> {
        let mut model = ObjectModel::empty(config, capture)?;
        model.restore(c, file)?;
        Ok(model)
    }

    /// A model without a surface.
    fn empty(config: Config, capture: &ObjectCapture) -> Result<ObjectModel> {
        let (probe, notes) = first_probe(&config)?;
        Ok(ObjectModel {
            probe,
            notes,
            placement: capture.placement,
            stage: Stage::Topology(Box::new(Topology::new(&config)?)),
            origin: Origin::default(),
            rate_scale: 1.0,
            bias: 0.0,
            beginnings: 1,
            config,
        })
    }

    /// Finds the surface that the first stage begins with.
    fn begin(&mut self, capture: &ObjectCapture) {
        let Stage::Topology(first) = &mut self.stage else { return };
        if self.config.grid.start == "random" {
            return first.begin_random(self.config.seed, self.bias);
        }
        let mut carving = None;
        if self.config.grid.start == "carved" {
            let photos: Vec<_> = capture.indices(Split::Train).into_iter().map(|i| &capture.photos[i]).collect();
            carving = Carving::of(&photos, &capture.silhouettes, &self.placement);
            if carving.is_none() {
                let why = "the photographs agree on too little of the surface to carve it";
                self.notes.push(format!("{why}: the first surface is the hull of the masks"));
            }
        }
        first.begin(&capture.silhouettes, &self.placement, carving.as_ref(), self.bias);
    }

    /// Begins the first stage again.
    pub fn begin_again(&mut self, capture: &ObjectCapture, bias: f32, rate_scale: f32) -> Result<()> {
        self.probe = first_probe(&self.config)?.0;
        (self.bias, self.rate_scale, self.beginnings) = (bias, rate_scale, self.beginnings + 1);
        self.stage = Stage::Topology(Box::new(Topology::new(&self.config)?));
        self.begin(capture);
        Ok(())
    }

    /// Goes on to the second stage.
    ///
    /// # Errors
    /// When the surface has no part that photographs show.
    pub fn give_texture(&mut self, capture: &ObjectCapture) -> Result<()> {
        let Stage::Topology(first) = &self.stage else { return Ok(()) };
        let mut mesh = first.mesh();
        let cameras: Vec<_> = capture.photos.iter().map(|p| (p.view.camera, p.view.pose)).collect();
        clean::remove_unseen(&mut mesh, &cameras, 0.5 * first.cell());
        clean::remove_floaters(&mut mesh, FLOATER);
        if mesh.faces.is_empty() {
            return Err(PipelineError::Usage("no part of the surface is seen by the photographs; train with more topology steps".into()));
        }
        self.stage = Stage::Textured(Box::new(Textured::new(&self.config, &mesh, Some(&first.material))));
        Ok(())
    }

    /// Goes on to the third stage: shadows and light between surfaces are traced.
    pub fn give_surroundings(&mut self, capture: &ObjectCapture) {
        if let Stage::Textured(m) = &mut self.stage
            && m.surroundings.is_none()
        {
            traced::begin(m, &self.config, capture, &mut self.probe);
        }
    }

    /// The picture `[H, W, 4]` of a view, linear light times opacity.
    pub fn picture(&self, view: &ObjectView) -> Vec<f32> {
        match &self.stage {
            Stage::Topology(m) => m.picture(view, &self.probe),
            Stage::Textured(m) => {
                let [color, _] = m.picture(view, &self.probe);
                color
            }
        }
    }

    /// Everything that is trained by gradients.
    pub fn params(&mut self) -> ParamSet<'_> {
        let mut params = ParamSet::default();
        match &mut self.stage {
            Stage::Topology(m) => params.add("", [&mut m.distances, &mut m.offsets, &mut m.material.table, &mut m.material.weights]),
            Stage::Textured(m) => params.add("", [&mut m.positions, &mut m.texels]),
        }
        params.add("", [&mut self.probe.group]);
        params
    }

    /// Writes a checkpoint.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn save(&mut self, folder: &Path) -> Result<()> {
        let mut metadata = HashMap::from([
            ("method".to_string(), "relight-object".to_string()),
            ("stage".into(), self.stage.name().to_string()),
            ("step".into(), self.origin.step.to_string()),
            ("seconds_bits".into(), self.origin.seconds.to_bits().to_string()),
            ("rate_scale_bits".into(), self.rate_scale.to_bits().to_string()),
            ("bias_bits".into(), self.bias.to_bits().to_string()),
            ("beginnings".into(), self.beginnings.to_string()),
            ("scale_bits".into(), self.placement.scale.to_bits().to_string()),
        ]);
        for (k, v) in self.placement.center.to_array().iter().enumerate() {
            metadata.insert(format!("center{k}_bits"), v.to_bits().to_string());
        }
        let layout = match &self.stage {
            Stage::Topology(_) => Vec::new(),
            Stage::Textured(m) => layout_arrays(&m.layout),
        };
        let mut entries: Vec<Entry> = param_state::entries(self.params());
        entries.extend(layout.iter().map(|(name, values)| entry(*name, values)));
        Ok(checkpoint::save(folder, &entries, metadata)?)
    }

    /// Takes over a checkpoint of the same configuration.
    ///
    /// # Errors
    /// When the checkpoint is of another method or shape.
    fn restore(&mut self, mut c: Checkpoint, file: &Path) -> Result<()> {
        fn number<T: std::str::FromStr>(c: &Checkpoint, key: &str, file: &Path) -> Result<T> {
            let value = c.metadata.get(key).and_then(|v| v.parse().ok());
            value.ok_or_else(|| PipelineError::Usage(format!("{}: metadata {key} is missing or malformed", file.display())))
        }
        self.origin = Origin { step: number(&c, "step", file)?, seconds: f64::from_bits(number(&c, "seconds_bits", file)?) };
        self.rate_scale = f32::from_bits(number(&c, "rate_scale_bits", file)?);
        self.bias = f32::from_bits(number(&c, "bias_bits", file)?);
        self.beginnings = number(&c, "beginnings", file)?;
        let mut center = [0.0; 3];
        for (k, v) in center.iter_mut().enumerate() {
            *v = f64::from_bits(number(&c, &format!("center{k}_bits"), file)?);
        }
        self.placement = Placement { center: DVec3::from(center), scale: f64::from_bits(number(&c, "scale_bits", file)?) };
        let stage = c.metadata.get("stage").cloned().unwrap_or_default();
        if stage != "topology" {
            self.stage = Stage::Textured(Box::new(Textured::of(&self.config, take_layout(&mut c, file)?)));
        }
        param_state::restore(&mut self.params(), &mut c, file)?;
        self.probe.update();
        if let Stage::Textured(m) = &mut self.stage
            && stage == "traced"
        {
            m.surroundings = Some(Box::new(traced::surroundings(m, &self.config)));
            self.probe.group.adam.rate = self.config.optim.traced_light_rate;
        }
        Ok(())
    }
}

/// The light to begin with, or the one that is given, with notes about its file.
fn first_probe(config: &Config) -> Result<(Probe, Vec<String>)> {
    let size = config.light.cube;
    if config.light.fixed.as_os_str().is_empty() {
        let adam = Adam { rate: config.optim.light_rate, beta2: 0.999, epsilon: 1e-8, ..Adam::default() };
        return Ok((Probe::new(size, adam), Vec::new()));
    }
    let (light, notes) = LightOptions::of(Source::File(config.light.fixed.clone())).read()?;
    Ok((Probe::given(size, &light.environment), notes))
}

/// A mesh of a file in object space.
fn base_mesh(path: &Path, placement: &Placement) -> Result<Mesh> {
    let loaded = model_file::read(path)?;
    let mesh = joined(&loaded.model);
    if mesh.faces.is_empty() {
        return Err(DataError::input(path, "holds no triangles").into());
    }
    Ok(Mesh { positions: mesh.positions.iter().map(|p| placement.of_world(*p)).collect(), ..mesh })
}

/// The triangles of all instances of a model; vertices at the same place become one.
pub fn joined(model: &Model) -> Mesh {
    let mut mesh = Mesh::default();
    let mut known: HashMap<[u32; 3], u32> = HashMap::new();
    for instance in &model.instances {
        let part = &model.parts[instance.part].mesh;
        let mirrors = DMat3::from_cols_array(&instance.world_from_part.matrix3.to_cols_array()).determinant() < 0.0;
        let mut number = |i: u32| {
            let p = instance.world_from_part.transform_point3(DVec3::from(part.positions[i as usize].map(f64::from))).as_vec3().to_array();
            *known.entry(p.map(f32::to_bits)).or_insert_with(|| {
                mesh.positions.push(p);
                mesh.positions.len() as u32 - 1
            })
        };
        let faces: Vec<[u32; 3]> = part.faces.iter().map(|f| f.map(&mut number)).collect();
        mesh.faces.extend(
            faces.into_iter().filter(|[a, b, c]| a != b && b != c && c != a).map(|[a, b, c]| if mirrors { [a, c, b] } else { [a, b, c] }),
        );
    }
    mesh
}

/// A layout as numbers; indices are exact below 2²⁴.
fn layout_arrays(l: &Layout) -> Vec<(&'static str, Vec<f32>)> {
    let indices = |v: &[u32]| v.iter().map(|i| *i as f32).collect();
    vec![
        ("layout.faces", indices(l.faces.as_flattened())),
        ("layout.uv_faces", indices(l.uv_faces.as_flattened())),
        ("layout.source", indices(&l.source)),
        ("layout.uvs", l.uvs.as_flattened().to_vec()),
        ("layout.initial", l.initial.as_flattened().to_vec()),
    ]
}

fn take_layout(c: &mut Checkpoint, file: &Path) -> Result<Layout> {
    let mut take =
        |name: &str| c.take(name).ok_or_else(|| PipelineError::Usage(format!("{}: {name} is missing; train again", file.display())));
    let triples = |v: Vec<f32>| -> Vec<[u32; 3]> { v.as_chunks::<3>().0.iter().map(|f| f.map(|i| i as u32)).collect() };
    let layout = Layout {
        faces: triples(take("layout.faces")?),
        uv_faces: triples(take("layout.uv_faces")?),
        source: take("layout.source")?.iter().map(|i| *i as u32).collect(),
        uvs: take("layout.uvs")?.as_chunks::<2>().0.to_vec(),
        initial: take("layout.initial")?.as_chunks::<3>().0.to_vec(),
    };
    let below = |faces: &[[u32; 3]], n: usize| faces.iter().flatten().all(|i| (*i as usize) < n);
    let is_sound = below(&layout.faces, layout.initial.len())
        && below(&layout.uv_faces, layout.uvs.len())
        && layout.source.len() == layout.uvs.len()
        && layout.source.iter().all(|i| (*i as usize) < layout.initial.len())
        && layout.faces.len() == layout.uv_faces.len();
    is_sound.then_some(layout).ok_or_else(|| PipelineError::Usage(format!("{}: its mesh is damaged; train again", file.display())))
}
