//! Flags, one place per flag; meaning lies in `commands`.

use crate::commands::{self, Outcome};
use crate::terminal;
use clap::{Args, CommandFactory, Parser, Subcommand};
use std::path::PathBuf;
use std::process::ExitCode;

/// Photographs to radiance fields, novel views and meshes.
#[derive(Parser)]
#[command(
    name = "diorama",
    version,
    arg_required_else_help = true,
    after_help = "Exit codes: 0 done, 1 the work failed, 2 bad input or usage, 130 interrupted with a checkpoint written."
)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Photographs or a video to a data set, through COLMAP or with the poses that they have
    #[command(
        after_help = "Examples:\n  diorama prepare photos/ -o data/chair\n  diorama prepare chair.mp4 -o data/chair --frames 120\n  diorama prepare photos/ -o data/chair --resume --remove-background auto\n  diorama prepare posed/ -o data/chair --sfm none --remove-background auto\n\nCOLMAP (and ffmpeg for videos) must be installed; DIORAMA_COLMAP and DIORAMA_FFMPEG name other programs than those in PATH."
    )]
    Prepare(PrepareArgs),
    /// Fit a field to photographs with poses
    #[command(
        after_help = "Examples:\n  diorama train capture/ -o runs/chair --seconds 120\n  diorama train lego/ -o runs/lego --method mlp --downscale 8 --background white\n  diorama train capture/ -o runs/chair --resume"
    )]
    Train(TrainArgs),
    /// Score held-out views
    #[command(after_help = "Example:\n  diorama eval runs/chair --save-images --json")]
    Eval(EvalArgs),
    /// Render novel views along a camera path
    #[command(
        after_help = "Examples:\n  diorama render runs/chair --video orbit.mp4\n  diorama render runs/chair --path camera_path.json --layers rgb,depth,normal --images frames/"
    )]
    Render(RenderArgs),
    /// Extract a mesh or a point cloud
    #[command(
        after_help = "Examples:\n  diorama export runs/chair -o chair.glb\n  diorama export runs/chair --scale-to 80cm -o chair.usdz\n  diorama export runs/chair --resolution 384 --faces 100000 --watertight --units mm -o chair.stl\n  diorama export runs/chair --format points --points 2000000 -o chair.ply\n  diorama export runs/chair -o chair.e57"
    )]
    Export(ExportArgs),
    /// Look at a run in the browser: views, cameras, crop box, scale, camera paths, meshes; or at a data set's cameras and points
    #[command(
        after_help = "Examples:\n  diorama view runs/chair\n  diorama view data/chair\n  diorama view splats.ply\n  diorama view runs/chair --host 0.0.0.0 --port 8080"
    )]
    View(ViewArgs),
    /// Runs side by side: curves, held-out images, cost
    #[command(after_help = "Example:\n  diorama compare runs/a runs/b -o runs/compare")]
    Compare(CompareArgs),
    /// Everything at once on a capture that the program generates itself
    #[command(after_help = "Example:\n  diorama quickstart --seconds 30 -o runs/first")]
    Quickstart(QuickstartArgs),
    /// What a capture or a run is
    #[command(after_help = "Examples:\n  diorama info data/chair\n  diorama info runs/chair --json")]
    Info(InfoArgs),
    /// What this machine offers, and what each missing part disables; of a capture, what will likely go wrong
    #[command(after_help = "Examples:\n  diorama doctor\n  diorama doctor data/chair")]
    Doctor(DoctorArgs),
    /// Completions for a shell, to be put where it looks for them
    #[command(
        after_help = "Examples:\n  diorama completions bash > ~/.local/share/bash-completion/completions/diorama\n  diorama completions zsh > ~/.zfunc/_diorama\n  diorama completions fish > ~/.config/fish/completions/diorama.fish"
    )]
    Completions(CompletionsArgs),
    /// Manual pages, one per verb
    #[command(after_help = "Example:\n  diorama man ~/.local/share/man/man1 && man diorama-train")]
    Man(ManArgs),
    /// Measure the kernels and the training step on this machine
    #[command(subcommand)]
    Bench(Bench),
}

#[derive(Subcommand)]
enum Bench {
    /// Each op against the machine's own measured limits
    #[command(after_help = "Example:\n  diorama bench ops --threads 2 --json")]
    Ops(BenchOpsArgs),
    /// Where the time of a training step goes; nothing is written
    #[command(after_help = "Example:\n  diorama bench train capture/ --downscale 4 --steps 200")]
    Train(BenchTrainArgs),
    /// Frames per second of a run's held-out views, and what the fast quality costs
    #[command(after_help = "Example:\n  diorama bench render runs/chair --json")]
    Render(BenchRenderArgs),
    /// A surface from a grid of densities, with normals, to a file
    #[command(after_help = "Example:\n  diorama bench mesh runs/chair --resolution 512 --save-grid grid.npy")]
    Mesh(BenchMeshArgs),
    /// Every op on a GPU against its f64 reference; exit code 1 if one is wrong
    #[command(after_help = "Example:\n  diorama bench check --device vulkan")]
    Check(BenchCheckArgs),
}

/// Flags of verbs that read a capture with masks.
#[derive(Args, Clone, Debug)]
pub struct MaskArgs {
    /// Masks beside the photographs: use (black is left out), invert or ignore [default: use]
    #[arg(long, value_name = "use|invert|ignore")]
    pub mask: Option<String>,
    /// What masks leave out: object (empty space), unknown (anything), or auto, told by what they cover [default: auto]
    #[arg(long, value_name = "auto|object|unknown")]
    pub mask_meaning: Option<String>,
}

/// Flags of `prepare`.
#[derive(Args, Clone, Debug)]
pub struct PrepareArgs {
    /// Folder of photographs, or a video; with --sfm none a capture that has poses
    pub input: PathBuf,
    /// Folder of the data set
    #[arg(short, long)]
    pub out: PathBuf,
    /// Where poses come from: colmap, or none for a capture that has them (transforms.json, COLMAP model, poses_bounds.npy)
    #[arg(long, default_value = "colmap")]
    pub sfm: String,
    /// With --sfm none: transforms, blender, colmap or llff, where a folder holds several
    #[arg(long)]
    pub format: Option<String>,
    #[command(flatten)]
    pub masks: MaskArgs,
    /// Most frames of a video; the sharpest of each stretch is taken
    #[arg(long, default_value_t = 150, conflicts_with = "fps")]
    pub frames: usize,
    /// Frames per second of a video, instead of --frames
    #[arg(long)]
    pub fps: Option<f64>,
    /// Take every N-th photograph
    #[arg(long, default_value_t = 1)]
    pub every: usize,
    /// Reduce photographs whose longest side is larger
    #[arg(long, value_name = "PIXELS")]
    pub max_side: Option<u32>,
    /// Pairs that are compared: auto, exhaustive or sequential
    #[arg(long, default_value = "auto")]
    pub matcher: String,
    /// Most features per photograph; matching takes time with the square of it
    #[arg(long, default_value_t = 8192)]
    pub features: usize,
    /// COLMAP's camera model: SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV or OPENCV_FISHEYE
    #[arg(long, default_value = "OPENCV")]
    pub lens: String,
    /// Keep only some photographs: diverse:N, the N that differ most in place, direction and looks
    #[arg(long, value_name = "diverse:N")]
    pub select: Option<String>,
    /// Cut the photographs once their poses are known: square, or x,y,width,height in pixels
    #[arg(long)]
    pub crop: Option<String>,
    /// Remove noise (non-local means, as strong as the noise that is measured)
    #[arg(long)]
    pub denoise: bool,
    /// Make exposure and white balance equal, by the points that several photographs show
    #[arg(long)]
    pub normalize_exposure: bool,
    /// off, auto (by the points of what the cameras look at), or a segmentation network: NETWORK.onnx
    #[arg(long, default_value = "off")]
    pub remove_background: String,
    /// every:N, A:B:C (percent), all, or file: as the capture says [default: every:8; with --sfm none file]
    #[arg(long)]
    pub split: Option<String>,
    #[arg(long, default_value_t = 0)]
    pub seed: u64,
    /// Leave out photographs that cannot be decoded, for example because they were cut off, and list them
    #[arg(long)]
    pub skip_broken: bool,
    /// Fail where fewer photographs than this percentage find a pose
    #[arg(long, default_value_t = 80.0)]
    pub min_registered: f64,
    #[arg(long)]
    pub threads: Option<usize>,
    /// Go on from what an interrupted call left
    #[arg(long)]
    pub resume: bool,
    /// Replace an earlier data set
    #[arg(long, conflicts_with = "resume")]
    pub force: bool,
    #[arg(long)]
    pub json: bool,
}

/// Flags of `train`.
#[derive(Args, Clone, Debug)]
pub struct TrainArgs {
    /// Folder with photographs and transforms.json, transforms_train.json, a COLMAP model or poses_bounds.npy
    pub data: Option<PathBuf>,
    /// With --resume: where the photographs are now, if they moved
    #[arg(long = "data", value_name = "FOLDER", requires = "resume", conflicts_with = "data")]
    pub moved: Option<PathBuf>,
    /// Folder of the run
    #[arg(short, long)]
    pub out: PathBuf,
    /// ngp, nerf, mlp or baseline [default: ngp]
    #[arg(long)]
    pub method: Option<String>,
    /// transforms, blender, colmap or llff, where a folder holds several
    #[arg(long)]
    pub format: Option<String>,
    /// Reduce the photographs N times
    #[arg(long)]
    pub downscale: Option<u32>,
    /// Stop after N steps
    #[arg(long)]
    pub steps: Option<u64>,
    /// Stop after S seconds of training
    #[arg(long, allow_negative_numbers = true)]
    pub seconds: Option<f64>,
    /// every:N, A:B:C (percent), file or all
    #[arg(long)]
    pub split: Option<String>,
    #[command(flatten)]
    pub masks: MaskArgs,
    /// auto, white, black, random or learned
    #[arg(long)]
    pub background: Option<String>,
    /// auto, cpu, cuda, vulkan, metal or webgpu; auto is the best GPU that the build reaches, else the CPU
    #[arg(long)]
    pub device: Option<String>,
    #[arg(long)]
    pub threads: Option<usize>,
    #[arg(long)]
    pub seed: Option<u64>,
    /// Leave out photographs that cannot be decoded, for example because they were cut off, and list them
    #[arg(long)]
    pub skip_broken: bool,
    /// `report`: the shortest side of each photograph becomes 100 pixels
    #[arg(long, conflicts_with = "downscale")]
    pub preset: Option<String>,
    /// Override a configuration value, for example loss.distortion=0.01; may be repeated
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub overrides: Vec<String>,
    /// Start from a config.toml
    #[arg(long)]
    pub config: Option<PathBuf>,
    /// Show the run in the browser while it trains
    #[arg(long)]
    pub view: bool,
    #[command(flatten)]
    pub listen: ListenArgs,
    /// Go on from the last checkpoint
    #[arg(long)]
    pub resume: bool,
    /// Replace what the run folder holds
    #[arg(long)]
    pub force: bool,
    /// Print one JSON object on stdout
    #[arg(long)]
    pub json: bool,
}

/// Flags of `eval`.
#[derive(Args, Clone, Debug)]
pub struct EvalArgs {
    /// Folder of the run
    pub run: PathBuf,
    /// Where the photographs are now, if they moved
    #[arg(long, value_name = "FOLDER")]
    pub data: Option<PathBuf>,
    /// auto, cpu, cuda, vulkan, metal or webgpu
    #[arg(long, default_value = "auto")]
    pub device: String,
    /// train, val or test
    #[arg(long, default_value = "test")]
    pub on: String,
    /// full, or fast as for previews
    #[arg(long, default_value = "full")]
    pub quality: String,
    /// Also judge by LPIPS with these weights: AlexNet or VGG16 and the linear heads, safetensors or PyTorch's .pth, in one file or two
    #[arg(long, value_name = "FILE[,FILE]", value_delimiter = ',')]
    pub lpips: Vec<PathBuf>,
    /// Write each render beside its photograph into RUN/eval
    #[arg(long)]
    pub save_images: bool,
    /// Tell how many training views see what each view shows, and the PSNR where two or more do; maps in RUN/eval: purple none, red 1, orange 2, yellow 3, green more, gray nothing
    #[arg(long)]
    pub explain: bool,
    #[arg(long)]
    pub threads: Option<usize>,
    #[arg(long)]
    pub json: bool,
}

/// Flags of `render`.
#[derive(Args, Clone, Debug)]
pub struct RenderArgs {
    /// Folder of the run
    pub run: PathBuf,
    /// auto, cpu, cuda, vulkan, metal or webgpu
    #[arg(long, default_value = "auto")]
    pub device: String,
    /// orbit, spiral, interpolate, held-out, or a camera_path.json
    #[arg(long, default_value = "orbit")]
    pub path: String,
    /// How many frames [default: 90, or all held-out views]
    #[arg(long)]
    pub frames: Option<usize>,
    /// WIDTHxHEIGHT [default: that of the run, or of the path's file]
    #[arg(long)]
    pub size: Option<String>,
    /// Horizontal field of view in degrees [default: that of the capture, or of the path's file]
    #[arg(long)]
    pub fov: Option<f64>,
    /// rgb, depth, normal, opacity, occupancy
    #[arg(long, default_value = "rgb", value_delimiter = ',')]
    pub layers: Vec<String>,
    /// Folder for PNG sequences [default: RUN/render unless --video is given]
    #[arg(long)]
    pub images: Option<PathBuf>,
    /// Film of the first layer: .mp4, or .gif with up to 50 frames per second
    #[arg(long)]
    pub video: Option<PathBuf>,
    /// [default: 30, or that of the path's file]
    #[arg(long)]
    pub fps: Option<u32>,
    /// How the layer depth keeps distances, beside its pictures: png (16 bit, one step for the sequence, in depth.json), exr or npy (floats)
    #[arg(long, default_value = "png")]
    pub depth: String,
    /// Meters per unit of the capture, for distances [default: by the length measured in the viewer, else unknown]
    #[arg(long)]
    pub scale: Option<f64>,
    /// Show only what lies in x0,y0,z0,x1,y1,z1 (the input's frame), or all [default: the crop box saved in the viewer, else all]
    #[arg(long, allow_hyphen_values = true)]
    pub clip: Option<String>,
    /// full, or fast for previews
    #[arg(long, default_value = "full")]
    pub quality: String,
    #[arg(long)]
    pub threads: Option<usize>,
    #[arg(long)]
    pub json: bool,
}

/// Flags of `export`.
#[derive(Args, Clone, Debug)]
pub struct ExportArgs {
    /// Folder of the run
    pub run: PathBuf,
    /// auto, cpu, cuda, vulkan, metal or webgpu
    #[arg(long, default_value = "auto")]
    pub device: String,
    /// glb, obj, ply, stl, usdz or dae; points (a point cloud: ply, las or e57) [default: the extension of --out]
    #[arg(long)]
    pub format: Option<String>,
    /// How many points a point cloud gets [default: 1000000]
    #[arg(long, value_name = "N")]
    pub points: Option<usize>,
    /// The file to write
    #[arg(short, long)]
    pub out: PathBuf,
    /// mc: marching cubes; mt: marching tetrahedra, some twice the faces before they are reduced
    #[arg(long, default_value = "mc")]
    pub extract: String,
    /// Cells along the longest side
    #[arg(long, default_value_t = 320)]
    pub resolution: usize,
    /// auto, or the density of the surface in inverse units of the input
    #[arg(long, default_value = "auto")]
    pub level: String,
    /// Most faces; 0 keeps all [default: 60000 with a texture, 200000 without]
    #[arg(long)]
    pub faces: Option<usize>,
    /// Edge of the texture in texels; 0 colours the vertices instead [default: 2048 where the format has textures]
    #[arg(long)]
    pub texture: Option<usize>,
    /// Bake the field's normals too, for a material that is lit; glb and obj
    #[arg(long)]
    pub normal_map: bool,
    /// Close the mesh, as printing needs it, or fail
    #[arg(long)]
    pub watertight: bool,
    /// Metres per unit of the capture [default: by the length measured in the viewer, else 1]
    #[arg(long, conflicts_with_all = ["scale_to", "measured"])]
    pub scale: Option<f64>,
    /// Make the longest side so long, for example 80cm, 0.8m, 800mm or 31.5in
    #[arg(long, value_name = "LENGTH", conflicts_with = "measured")]
    pub scale_to: Option<String>,
    /// Two points of the capture and their true distance: x0,y0,z0,x1,y1,z1=45cm
    #[arg(long, value_name = "POINTS=LENGTH", allow_hyphen_values = true)]
    pub measured: Option<String>,
    /// Unit of the coordinates in obj, ply, stl and las: m, cm, mm or in; the others are in metres by their standards
    #[arg(long, default_value = "m")]
    pub units: String,
    /// Extract only x0,y0,z0,x1,y1,z1 (the input's frame), or auto, or all (points only) [default: the crop box saved in the viewer, else auto: what most cameras look at]
    #[arg(long, allow_hyphen_values = true)]
    pub clip: Option<String>,
    /// Remove parts with fewer faces than this share of the largest part's
    #[arg(long, default_value_t = 0.01)]
    pub floaters: f32,
    /// Keep parts that fewer than three training cameras see, and parts that stand close before one
    #[arg(long)]
    pub keep_unseen: bool,
    #[arg(long)]
    pub threads: Option<usize>,
    /// Replace an existing file
    #[arg(long)]
    pub force: bool,
    #[arg(long)]
    pub json: bool,
}

/// Flags of `view`, and of `train --view`.
#[derive(Args, Clone, Debug)]
pub struct ListenArgs {
    /// Address to listen on; any but 127.0.0.1 asks for a token, which is part of the printed address
    #[arg(long, default_value = "127.0.0.1")]
    pub host: std::net::IpAddr,
    /// 0: any that is free
    #[arg(long, default_value_t = 7007)]
    pub port: u16,
}

/// Flags of `view`.
#[derive(Args, Clone, Debug)]
pub struct ViewArgs {
    /// Folder of a run or of a data set, or a PLY file of points or Gaussian splats
    pub path: PathBuf,
    /// Of a run: where its photographs are now, if they moved
    #[arg(long, value_name = "FOLDER")]
    pub data: Option<PathBuf>,
    /// auto, cpu, cuda, vulkan, metal or webgpu
    #[arg(long, default_value = "auto")]
    pub device: String,
    #[command(flatten)]
    pub listen: ListenArgs,
    #[arg(long)]
    pub threads: Option<usize>,
    /// Print the address as a JSON object on stdout
    #[arg(long)]
    pub json: bool,
}

/// Flags of `compare`.
#[derive(Args, Clone, Debug)]
pub struct CompareArgs {
    /// Folders of runs
    #[arg(required = true)]
    pub runs: Vec<PathBuf>,
    /// Where the photographs of all runs are now, if they moved
    #[arg(long, value_name = "FOLDER")]
    pub data: Option<PathBuf>,
    /// Folder for curves.svg, curves.png, views.png and compare.json
    #[arg(short, long, default_value = "runs/compare")]
    pub out: PathBuf,
    #[arg(long)]
    pub json: bool,
}

/// Flags of `quickstart`.
#[derive(Args, Clone, Debug)]
pub struct QuickstartArgs {
    /// Folder for everything that is made
    #[arg(short, long, default_value = "runs/quickstart")]
    pub out: PathBuf,
    /// Seconds of training
    #[arg(long, default_value_t = 90.0)]
    pub seconds: f64,
    #[arg(long)]
    pub threads: Option<usize>,
    /// Replace an earlier quickstart
    #[arg(long)]
    pub force: bool,
    #[arg(long)]
    pub json: bool,
}

/// Flags of `info`.
#[derive(Args, Clone, Debug)]
pub struct InfoArgs {
    /// A capture's folder or a run's
    pub path: PathBuf,
    /// Format of a capture, where a folder holds several
    #[arg(long)]
    pub format: Option<String>,
    #[arg(long)]
    pub json: bool,
}

/// Flags of `doctor`.
#[derive(Args, Clone, Debug)]
pub struct DoctorArgs {
    /// A capture's folder; without it, this machine
    pub data: Option<PathBuf>,
    /// Format of a capture, where a folder holds several
    #[arg(long, requires = "data")]
    pub format: Option<String>,
    #[command(flatten)]
    pub masks: MaskArgs,
    #[arg(long)]
    pub json: bool,
}

/// Flags of `completions`.
#[derive(Args, Clone, Debug)]
pub struct CompletionsArgs {
    pub shell: clap_complete::Shell,
}

/// Flags of `man`.
#[derive(Args, Clone, Debug)]
pub struct ManArgs {
    /// Folder for the pages, which are named after their verbs
    pub folder: PathBuf,
}

/// Flags of `bench ops`.
#[derive(Args, Clone, Debug)]
pub struct BenchOpsArgs {
    #[arg(long)]
    pub threads: Option<usize>,
    /// cpu, cuda, vulkan, metal or webgpu
    #[arg(long, default_value = "cpu")]
    pub device: String,
    /// Calls per figure; the median counts
    #[arg(long, default_value_t = 9)]
    pub repeats: usize,
    #[arg(long)]
    pub json: bool,
}

/// Flags of `bench train`.
#[derive(Args, Clone, Debug)]
pub struct BenchTrainArgs {
    /// Folder of the capture
    pub data: PathBuf,
    #[arg(long, default_value = "ngp")]
    pub method: String,
    #[arg(long, default_value_t = 1)]
    pub downscale: u32,
    #[arg(long, default_value = "file")]
    pub split: String,
    #[arg(long, default_value = "auto")]
    pub device: String,
    /// Steps before the measured ones
    #[arg(long, default_value_t = 300)]
    pub warmup: u64,
    /// Measured steps
    #[arg(long, default_value_t = 200)]
    pub steps: u64,
    #[arg(long)]
    pub threads: Option<usize>,
    /// Override a configuration value; may be repeated
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub overrides: Vec<String>,
    #[arg(long)]
    pub json: bool,
}

/// Flags of `bench render`.
#[derive(Args, Clone, Debug)]
pub struct BenchRenderArgs {
    /// Folder of the run
    pub run: PathBuf,
    /// auto, cpu, cuda, vulkan, metal or webgpu
    #[arg(long, default_value = "auto")]
    pub device: String,
    /// Calls per view; the median counts
    #[arg(long, default_value_t = 5)]
    pub repeats: usize,
    #[arg(long)]
    pub threads: Option<usize>,
    #[arg(long)]
    pub json: bool,
}

/// Flags of `bench mesh`.
#[derive(Args, Clone, Debug)]
pub struct BenchMeshArgs {
    /// Folder of the run
    pub run: PathBuf,
    /// Cells along the longest side
    #[arg(long, default_value_t = 512)]
    pub resolution: usize,
    /// Keep the densities as .npy, for other programs
    #[arg(long)]
    pub save_grid: Option<PathBuf>,
    /// Calls; the median counts
    #[arg(long, default_value_t = 5)]
    pub repeats: usize,
    #[arg(long)]
    pub threads: Option<usize>,
    #[arg(long)]
    pub json: bool,
}

/// Flags of `bench check`.
#[derive(Args, Clone, Debug)]
pub struct BenchCheckArgs {
    /// Also train on this capture, on the device and on the CPU, and compare the losses
    #[arg(long, value_name = "FOLDER")]
    pub data: Option<PathBuf>,
    /// cuda, vulkan, metal or webgpu
    #[arg(long)]
    pub device: String,
    #[arg(long)]
    pub json: bool,
}

/// Parses, runs, reports.
pub fn main() -> ExitCode {
    diorama_kernels::device::quiet_drivers();
    diorama_kernels::device::settle_cuda_path();
    let cli = match Cli::try_parse() {
        Ok(c) => c,
        Err(e) => {
            let _ = e.print();
            return ExitCode::from(if e.use_stderr() { terminal::USAGE } else { 0 });
        }
    };
    let json = match &cli.command {
        Command::Prepare(a) => a.json,
        Command::Train(a) => a.json,
        Command::Eval(a) => a.json,
        Command::Render(a) => a.json,
        Command::Export(a) => a.json,
        Command::View(a) => a.json,
        Command::Compare(a) => a.json,
        Command::Quickstart(a) => a.json,
        Command::Info(a) => a.json,
        Command::Doctor(a) => a.json,
        Command::Completions(_) | Command::Man(_) => false,
        Command::Bench(Bench::Ops(a)) => a.json,
        Command::Bench(Bench::Train(a)) => a.json,
        Command::Bench(Bench::Render(a)) => a.json,
        Command::Bench(Bench::Mesh(a)) => a.json,
        Command::Bench(Bench::Check(a)) => a.json,
    };
    let result = match cli.command {
        Command::Prepare(a) => commands::prepare::run(&a),
        Command::Train(a) => commands::train::run(&a),
        Command::Eval(a) => commands::eval::run(&a),
        Command::Render(a) => commands::render::run(&a),
        Command::Export(a) => commands::export::run(&a),
        Command::View(a) => commands::view::run(&a),
        Command::Compare(a) => commands::compare::run(&a),
        Command::Quickstart(a) => commands::quickstart::run(&a),
        Command::Info(a) => commands::info::run(&a),
        Command::Doctor(a) => commands::doctor::run(&a),
        Command::Completions(a) => commands::manual::completions(&a, Cli::command()),
        Command::Man(a) => commands::manual::pages(&a, Cli::command()),
        Command::Bench(Bench::Ops(a)) => commands::bench::ops(&a),
        Command::Bench(Bench::Train(a)) => commands::bench::train(&a),
        Command::Bench(Bench::Render(a)) => commands::bench::render(&a),
        Command::Bench(Bench::Mesh(a)) => commands::bench::mesh(&a),
        Command::Bench(Bench::Check(a)) => commands::bench::check(&a),
    };
    ExitCode::from(match result {
        Ok(Outcome::Done) => 0,
        Ok(Outcome::Interrupted) => terminal::INTERRUPTED,
        Err(e) => terminal::report(&e, json),
    })
}
