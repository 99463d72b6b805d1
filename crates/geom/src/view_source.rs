//! What a viewer needs of a run, without knowing what it is.

use crate::view_controls::{ControlValues, ViewControl, ViewLayer};
use crate::{Camera, ImageU8, Pose, Similarity};
use std::path::PathBuf;

/// A view to be drawn.
#[derive(Clone, Debug, PartialEq)]
pub struct ViewRequest {
    pub camera: Camera,
    pub world_from_camera: Pose,
    /// Id of a layer that the scene lists.
    pub layer: String,
    /// Values of the controls that the scene lists.
    pub values: ControlValues,
    /// Lowest and highest corner in the world of what is shown.
    pub clip: Option<([f32; 3], [f32; 3])>,
}

/// A camera that took a photograph.
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

/// What there is to look at.
#[derive(Clone, Debug, PartialEq)]
pub struct ViewScene {
    pub name: String,
    pub frames: Vec<ViewFrame>,
    /// Pictures that can be drawn of a view; the first is shown first.
    pub layers: Vec<ViewLayer>,
    /// Settings of these pictures.
    pub controls: Vec<ViewControl>,
    /// One line about what can be seen and what cannot, shown with the picture; may be empty.
    pub note: String,
    /// Whether crop box, scale and camera path can be kept and meshes made: only a run can.
    pub is_run: bool,
    /// What the cameras look at, and how far they stand from it.
    pub focus: [f64; 3],
    pub distance: f64,
    /// Meshes are made in the capture's frame.
    pub world_from_capture: Similarity,
    /// Lowest and highest corner in the world of what may be shown.
    pub bounds: ([f64; 3], [f64; 3]),
    /// The crop box as it was last saved.
    pub crop: Option<([f32; 3], [f32; 3])>,
    /// A length that was measured, in the world.
    pub measured: Option<MeasuredLength>,
    /// The camera path as it was last saved, nerfstudio's JSON with cameras in the world.
    pub path: Option<String>,
}

/// Two points and how far they are apart in truth.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MeasuredLength {
    pub points: [[f64; 3]; 2],
    pub metres: f64,
}

/// How far training is.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ViewStatus {
    pub step: u64,
    pub seconds: f64,
    /// Share of the training that is done, 0 to 1; 0 where nothing trains.
    pub progress: f64,
    pub running: bool,
    /// What the source wants shown, in its order.
    pub figures: Vec<ViewFigure>,
}

/// A figure of training, such as its loss.
#[derive(Clone, Debug, PartialEq)]
pub struct ViewFigure {
    /// By which lines of charts refer to it.
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
    /// What the line is called beside the others of its chart.
    pub label: String,
    /// Whether it is of data that was held out: few values, each shown as a dot.
    pub held_out: bool,
    /// Steps and values, oldest first.
    pub points: Vec<(u64, f64)>,
}

/// A mesh to be made.
#[derive(Clone, Debug, PartialEq)]
pub struct MeshRequest {
    /// glb, obj, ply, stl, usdz or dae.
    pub format: String,
    pub faces: usize,
    pub resolution: usize,
    pub clip: Option<([f32; 3], [f32; 3])>,
}

/// A run, or a data set, that can be looked at. Errors are one line for the user.
pub trait ViewSource: Send + Sync {
    fn scene(&self) -> ViewScene;

    fn status(&self) -> ViewStatus;

    /// Charts of training so far; none where nothing was trained. Asked again when the status has figures that it had not.
    fn charts(&self) -> Vec<ViewChart> {
        Vec::new()
    }

    /// Frames whose views lie behind fog, as far as is known.
    fn behind_fog(&self) -> Vec<usize> {
        Vec::new()
    }

    /// Draws a view as `[H, W, 3]` sRGB. Its layer and values are those of the scene's lists.
    fn view(&self, request: &ViewRequest) -> Result<ImageU8, String>;

    /// The place in the world that a pixel shows; none where nothing is.
    fn point(&self, request: &ViewRequest, x_px: f64, y_px: f64) -> Option<[f64; 3]>;

    /// A small photograph of a frame.
    fn thumbnail(&self, frame: usize) -> Result<ImageU8, String>;

    /// Keeps the crop box for `render` and `export`.
    fn save_crop(&self, crop: Option<([f32; 3], [f32; 3])>) -> Result<(), String>;

    /// Keeps a measured length (in the world) as the scale of exported meshes, or forgets it.
    fn save_measured(&self, measured: Option<MeasuredLength>) -> Result<(), String>;

    /// Keeps a camera path, nerfstudio's JSON with cameras in the world, for `render`; the file's name.
    fn save_path(&self, json: &str) -> Result<PathBuf, String>;

    /// The same path, given in the capture's frame as other programs write it, with cameras in the world.
    fn open_path(&self, json: &str) -> Result<String, String>;

    /// Makes a mesh; the file's name, and the metres of the mesh per unit of the capture.
    fn export(&self, request: &MeshRequest, progress: &mut dyn FnMut(&str, usize, usize)) -> Result<(PathBuf, f64), String>;
}
