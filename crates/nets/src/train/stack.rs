//! Images as one tensor, the way networks take them.

use crate::bridge::{OpError, ValuesMut};
use burn::backend::{BackendTensor, DispatchAutodiffContext, DispatchTensor, DispatchTensorKind};
use burn::tensor::{Device, Tensor, TensorData};
use diorama_geom::Image;

/// Stacks images of one size into a tensor, on the CPU in memory of the pool.
///
/// # Shapes
/// images `[H, W, C]` each; result `[N, C, H, W]`.
///
/// # Errors
/// When there is no image, or one has another size than the first.
pub fn stack(images: &[Image], device: &Device) -> Result<Tensor<4>, OpError> {
    let first = images.first().ok_or_else(|| OpError::settings("stack", "no images"))?;
    let (w, h, c) = (first.width, first.height, first.channels);
    if let Some(i) = images.iter().find(|i| (i.width, i.height, i.channels) != (w, h, c)) {
        return Err(OpError::shape("stack", "an image", &[i.height, i.width, i.channels], format!("[{h}, {w}, {c}]")));
    }
    let shape = [images.len(), c, h, w];
    let on_cpu = device.clone().without_autodiff() == Device::flex();
    if !on_cpu {
        let mut values = vec![0.0; shape.iter().product()];
        fill(images, &mut values);
        return Ok(Tensor::from_data(TensorData::new(values, shape), &device.clone().without_autodiff()));
    }
    let mut values = ValuesMut::any(&shape);
    fill(images, &mut values);
    let kind = DispatchTensorKind::Flex(BackendTensor::Float(values.freeze().into_tensor()));
    Ok(Tensor::from_dispatch(DispatchTensor { kind, autodiff: DispatchAutodiffContext::Disabled }))
}

/// Plane after plane of every image.
fn fill(images: &[Image], out: &mut [f32]) {
    let mut planes = out.chunks_exact_mut((images[0].width * images[0].height).max(1));
    for image in images {
        for (channel, plane) in (0..image.channels).zip(&mut planes) {
            let values = image.data[channel..].iter().step_by(image.channels);
            plane.iter_mut().zip(values).for_each(|(o, v)| *o = *v);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_testkit::random_unit;

    #[test]
    fn channels_become_planes() {
        let image = |seed| Image { width: 3, height: 2, channels: 2, data: random_unit(12, seed) };
        let images = [image(1), image(2)];
        let t = stack(&images, &Device::flex()).unwrap();
        assert_eq!(t.dims(), [2, 2, 2, 3]);
        let values = crate::read_values(t);
        for (i, v) in values.iter().enumerate() {
            let (n, c, y, x) = (i / 12, i / 6 % 2, i / 3 % 2, i % 3);
            assert_eq!(*v, images[n].pixel(x, y)[c]);
        }
    }

    #[test]
    fn images_of_other_sizes_and_none_are_refused() {
        let e = stack(&[Image::zeros(3, 2, 1), Image::zeros(2, 2, 1)], &Device::flex()).unwrap_err().to_string();
        assert_eq!(e, "stack: an image has shape [2, 2, 1], expected [2, 3, 1]");
        assert!(stack(&[], &Device::flex()).is_err());
    }
}
