//! Checks of rendering: views of the device compared with the CPU's.

use super::*;

/// A view that the device itself has drawn.
///
/// # Errors
/// When it failed, or did not draw at all: what the CPU draws in its place proves nothing.
fn drawn<T>(name: &str, device: Box<dyn Accelerator>, draw: impl FnOnce(&dyn Accelerator) -> T) -> Result<T, GpuError> {
    let device = Supervised::new(device, name, true, Box::new(|_| {}));
    let view = draw(&device);
    match device.fatal() {
        Some(why) => Err(GpuError::Lost(name.into(), why)),
        None if device.served() == 0 => Err(GpuError::Lost(name.into(), "it drew nothing of a view".into())),
        None => Ok(view),
    }
}

/// Views by the device and by the CPU, with room for all samples of a batch and with so little that it is split.
pub(super) fn views(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    let grid = HashGridConfig { levels: 3, features: 2, log2_size: 10, base: 4, finest: 16 };
    let camera =
        PosedCamera { camera: Camera::pinhole(12, 10, 0.6), pose: Pose::look_at(DVec3::new(1.9, 1.2, 1.0), DVec3::splat(0.5), DVec3::Z) };
    for (images, space) in [(0, contraction::Space::Cube(1.0)), (3, contraction::Space::Contracted(1.0))] {
        let mut f = fields::ngp(grid, space, 1e-2, images, if images > 0 { 4 } else { 0 }, 1);
        f.net.density.shift = 1.2;
        f.encoder.table_mut().into_iter().for_each(|t| t.values.iter_mut().for_each(|v| *v *= 2e4));
        let occupancy = Occupancy::new(16, 1, false);
        for (quality, room) in [(Quality::Full, 1 << 17), (Quality::Full, 4096), (Quality::Fast, 1 << 17)] {
            let on_cpu = Tracer {
                occupancy: Some(&occupancy),
                backdrop: volume::Backdrop::Color([0.2, 0.5, 0.9]),
                near: 0.1,
                shared_weight: 0.0,
                ..Tracer::new(&f, Placement::occupied(&occupancy, 4096, quality.pruning()), (0.0, 1.0))
            };
            let device = GpuTracer::new(gpu.clone(), &f, None, Some(&occupancy)).with_room(room);
            let want = on_cpu.view(&camera, &mut |_| {});
            let got = drawn(&gpu.name, Box::new(device), |by| Tracer { accelerator: Some(by), ..on_cpu }.view(&camera, &mut |_| {}))?;
            let shape = format!("{quality:?} room {room} images={images}");
            table.close("view", "color", &shape, &gpu.upload(&got.rgb.data), &wide(&want.rgb.data))?;
            table.close("view", "opacity", &shape, &gpu.upload(&got.opacity.data), &wide(&want.opacity.data))?;
            table.close("view", "depth", &shape, &gpu.upload(&got.depth.data), &wide(&want.depth.data))?;
        }
    }
    Ok(())
}

/// Views, densities and colours of fields without a grid.
pub(super) fn other_views(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    let camera =
        PosedCamera { camera: Camera::pinhole(6, 5, 0.6), pose: Pose::look_at(DVec3::new(1.9, 1.2, 1.0), DVec3::splat(0.5), DVec3::Z) };
    let (fine, coarse) =
        (fields::nerf(contraction::Space::Cube(1.0), 1e-3, 2, 4, 1, 1), fields::nerf(contraction::Space::Cube(1.0), 1e-3, 2, 4, 1, 0));
    let plain = fields::baseline(contraction::Space::Cube(2.0), 1e-3, 3);
    for (name, field, guide) in [("nerf", &fine, Some(&coarse)), ("baseline", &plain, None)] {
        let placement = match guide {
            Some(_) => Placement::Hierarchical { samples: 8, more: 8, noise: None },
            None => Placement::Stratified { samples: 16, noise: None },
        };
        let backdrop = volume::Backdrop::Color([0.2, 0.5, 0.9]);
        let on_cpu = Tracer { coarse: guide, backdrop, near: 0.1, ..Tracer::new(field, placement, (0.0, 1.0)) };
        // Room for all rays at once, and for some.
        for room in [1 << 10, 100] {
            let tracer = || GpuTracer::new(gpu.clone(), field, guide, None).with_room(room);
            let device = tracer();
            let want = on_cpu.view(&camera, &mut |_| {});
            let got = drawn(&gpu.name, Box::new(tracer()), |by| Tracer { accelerator: Some(by), ..on_cpu }.view(&camera, &mut |_| {}))?;
            let shape = format!("{name} room {room}");
            table.close("view", "color", &shape, &gpu.upload(&got.rgb.data), &wide(&want.rgb.data))?;
            table.close("view", "opacity", &shape, &gpu.upload(&got.opacity.data), &wide(&want.opacity.data))?;
            table.close("view", "depth", &shape, &gpu.upload(&got.depth.data), &wide(&want.depth.data))?;
            let (points, mut sigma) = (random_unit(450, 1), vec![0.0; 150]);
            field.density(&points, &mut sigma);
            table.close("view", "densities", &shape, &gpu.upload(&device.density(&points)?), &wide(&sigma))?;
            let dirs: Vec<f32> = points.chunks_exact(3).flat_map(unit).collect();
            let mut buf = FieldBuffers::default();
            let colors = wide(field.outputs_at(&points, &dirs, &[], &mut buf));
            table.close("view", "own colors", &shape, &gpu.upload(&device.color(&points, &dirs)?), &colors)?;
        }
    }
    Ok(())
}

fn unit(v: &[f32]) -> [f32; 3] {
    let length = (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt().max(1e-6);
    [v[0] / length, v[1] / length, v[2] / length]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::renderers::supervised::Unserved;
    use crate::renderers::volume::Traced;
    use crate::samplers::RayBatch;

    /// Evaluates densities where it works.
    struct Device {
        works: bool,
    }

    impl Accelerator for Device {
        fn trace(&self, _: &RayBatch, _: &Placement, _: Option<u32>) -> Result<(Traced, Option<Vec<f32>>), Unserved> {
            Err(Unserved::Failed("unplugged".into()))
        }
        fn density(&self, model: &[f32]) -> Result<Vec<f32>, Unserved> {
            if self.works { Ok(vec![1.0; model.len() / 3]) } else { Err(Unserved::Failed("unplugged".into())) }
        }
        fn color(&self, _: &[f32], _: &[f32]) -> Result<Vec<f32>, Unserved> {
            Err(Unserved::Failed("unplugged".into()))
        }
        fn rays(&self) -> usize {
            1
        }
    }

    #[test]
    fn what_a_device_did_not_draw_counts_as_lost() {
        let by = |works: bool, asked: bool| {
            let on_cpu = vec![2.0];
            drawn("fake", Box::new(Device { works }), |by| if asked { by.density(&[0.0; 3]).unwrap_or(on_cpu) } else { on_cpu })
        };
        assert_eq!(by(true, true).unwrap(), [1.0]);
        // The CPU's result is there both times.
        for (works, asked, why) in [(true, false, "it drew nothing of a view"), (false, true, "unplugged")] {
            let Err(GpuError::Lost(name, text)) = by(works, asked) else { panic!("works {works}, asked {asked}: it counts") };
            assert_eq!((&name[..], &text[..]), ("fake", why));
        }
    }
}
