//! Networks, each only as far as an application asks. Names of weights are those of torchvision where it has the network.

mod discriminator;
mod fpn;
mod renderer;
mod resnet;
#[cfg(test)]
mod tests;
mod unet;
mod vgg;
mod vit;

pub use discriminator::{Discriminator, SpectralConv};
pub use fpn::Fpn;
pub use renderer::{Renderer, RendererSettings};
pub use resnet::{Features, ResNet, ResNetSettings};
pub use unet::{UNet, UNetSettings};
pub use vgg::{Vgg, VggSettings};
pub use vit::{VIT_KEYS, Vit, VitSettings};
