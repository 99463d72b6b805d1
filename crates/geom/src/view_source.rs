//! The interface between a viewer and the source that it shows, such as a run or a data set.

use crate::view_controls::{ControlValues, ViewControl, ViewLayer};
use crate::{Camera, ImageU8, Pose, Similarity};
use std::path::PathBuf;

/// A view to render.
#[derive(Clone, Debug, PartialEq)]
pub struct ViewRequest {
    pub camera: Camera,
    pub world_from_camera: Pose,
    /// Id of a layer in the scene's list.
    pub layer: String,
    /// Values of the controls in the scene's list.
    pub values: ControlValues,
    /// Lowest and highest corner, in the world, of the visible region.
    pub clip: Option<([f32; 3], [f32; 3])>,
}

/// The camera of a photograph.
#[derive(Clone, Debug, PartialEq)]
pub struct ViewFrame {
    pub name: String,
    pub camera: Camera,
    pub world_from_camera: Pose,
    pub held_out: bool,
}

impl From<&crate::Frame> for ViewFrame {
    fn from(f: &crate::Frame) -> ViewFrame {
        let held_out = f.split != crate::capture::Split::Train;
        ViewFrame { name: f.name.clone(), camera: f.camera, world_from_camera: f.world_from_camera, held_out }
    }
}

/// Description of a source: cameras, layers, controls and saved settings.
#[derive(Clone, Debug, PartialEq)]
pub struct ViewScene {
    pub name: String,
    pub frames: Vec<ViewFrame>,
    /// Layers that can be rendered; the first one is shown at first.
    pub layers: Vec<ViewLayer>,
    /// Controls that change the layers.
    pub controls: Vec<ViewControl>,
    /// One line about what can be shown and what cannot, displayed with the picture; may be empty.
    pub note: String,
    /// Whether crop box, scale and camera path can be saved and meshes exported; only runs support this.
    pub is_run: bool,
    /// The point that the cameras look at, and their distance from it.
    pub focus: [f64; 3],
    pub distance: f64,
    /// Similarity from the capture's frame, in which meshes are written, to the world.
    pub world_from_capture: Similarity,
    /// Lowest and highest corner, in the world, of the region that can be shown.
    pub bounds: ([f64; 3], [f64; 3]),
    /// The crop box that was saved last.
    pub crop: Option<([f32; 3], [f32; 3])>,
    /// A measured length, in the world.
    pub measured: Option<MeasuredLength>,
    /// The camera path that was saved last: nerfstudio's JSON with cameras in the world.
    pub path: Option<String>,
}

/// Two points and their true distance.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MeasuredLength {
    pub points: [[f64; 3]; 2],
    pub metres: f64,
}

/// Progress of training.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ViewStatus {
    pub step: u64,
    pub seconds: f64,
    /// Completed share of the training, 0 to 1; 0 if nothing is being trained.
    pub progress: f64,
    pub running: bool,
    /// What the source wants shown, in its order.
    pub figures: Vec<ViewFigure>,
}

/// A figure of training, such as its loss.
#[derive(Clone, Debug, PartialEq)]
pub struct ViewFigure {
    /// Identifier, by which lines of charts refer to it.
    pub id: String,
    /// Name on the page.
    pub label: String,
    pub value: f64,
    /// The value with its unit, as the page shows it.
    pub text: String,
}

/// Figures over the steps of training, on common axes.
#[derive(Clone, Debug, PartialEq)]
pub struct ViewChart {
    /// Name on the page.
    pub label: String,
    pub unit: String,
    pub lines: Vec<ViewLine>,
}

/// A figure's values so far.
#[derive(Clone, Debug, PartialEq)]
pub struct ViewLine {
    /// Id of the figure whose values follow while training goes on.
    pub figure: String,
    /// Name of the line in its chart.
    pub label: String,
    /// Whether it is of data that was held out: few values, each shown as a dot.
    pub held_out: bool,
    /// Steps and values, oldest first.
    pub points: Vec<(u64, f64)>,
}

/// A request for a mesh.
#[derive(Clone, Debug, PartialEq)]
pub struct MeshRequest {
    /// glb, obj, ply, stl, usdz or dae.
    pub format: String,
    pub faces: usize,
    pub resolution: usize,
    pub clip: Option<([f32; 3], [f32; 3])>,
}

/// A run or a data set that a viewer can show. Errors are one line of text for the user.
pub trait ViewSource: Send + Sync {
    fn scene(&self) -> ViewScene;

    fn status(&self) -> ViewStatus;

    /// Charts of training so far; none where nothing was trained. Asked again when the status has figures that it had not.
    fn charts(&self) -> Vec<ViewChart> {
        Vec::new()
    }

    /// Frames whose views are behind fog, as far as known.
    fn behind_fog(&self) -> Vec<usize> {
        Vec::new()
    }

    /// Renders a view as `[H, W, 3]` sRGB. Its layer and values are from the scene's lists.
    fn view(&self, request: &ViewRequest) -> Result<ImageU8, String>;

    /// The point in the world that a pixel shows; `None` where there is no surface.
    fn point(&self, request: &ViewRequest, x_px: f64, y_px: f64) -> Option<[f64; 3]>;

    /// A thumbnail of a frame's photograph.
    fn thumbnail(&self, frame: usize) -> Result<ImageU8, String>;

    /// Saves the crop box for `render` and `export`.
    fn save_crop(&self, crop: Option<([f32; 3], [f32; 3])>) -> Result<(), String>;

    /// Saves a measured length (in the world) as the scale of exported meshes, or removes it.
    fn save_measured(&self, measured: Option<MeasuredLength>) -> Result<(), String>;

    /// Saves a camera path (nerfstudio's JSON with cameras in the world) for `render`; returns the file.
    fn save_path(&self, json: &str) -> Result<PathBuf, String>;

    /// Converts a camera path from the capture's frame, in which other programs write it, to cameras in the world.
    fn open_path(&self, json: &str) -> Result<String, String>;

    /// Exports a mesh; returns the file, and the meters of the mesh per unit of the capture.
    fn export(&self, request: &MeshRequest, progress: &mut dyn FnMut(&str, usize, usize)) -> Result<(PathBuf, f64), String>;
}
