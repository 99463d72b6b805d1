//! Networks, each only as far as an application asks. Names of weights are those of torchvision where it has the network.

mod db;
#[cfg(test)]
mod detector_tests;
mod discriminator;
mod east;
mod fpn;
mod renderer;
mod resnet;
#[cfg(test)]
mod tests;
mod to_onnx;
mod unet;
mod vgg;
mod vit;

pub use db::{Db, DbLoss, DbMaps, DbSettings, DbTruth, db_loss};
pub use discriminator::{Discriminator, SpectralConv};
pub use east::{East, EastLoss, EastMaps, EastSettings, EastTruth, east_loss};
pub use fpn::Fpn;
pub use renderer::{Renderer, RendererSettings};
pub use resnet::{Features, ResNet, ResNetSettings};
pub use unet::{UNet, UNetSettings};
pub use vgg::{Vgg, VggSettings};
pub use vit::{VIT_KEYS, Vit, VitSettings};
