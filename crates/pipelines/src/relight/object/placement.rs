//! Where an object is in the world. In object space it lies within −1 to 1; `x = (world − center) / scale`.

use diorama_geom::Pose;
use diorama_geom::glam::DVec3;

/// Where the object is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Placement {
    pub center: DVec3,
    pub scale: f64,
}

impl Placement {
    /// A pose in object space.
    pub fn pose(&self, world: &Pose) -> Pose {
        Pose { rotation: world.rotation, translation: (world.translation - self.center) / self.scale }
    }

    /// A pose of object space in the world.
    pub fn pose_in_world(&self, pose: &Pose) -> Pose {
        Pose { rotation: pose.rotation, translation: pose.translation * self.scale + self.center }
    }

    /// A point of object space in the world.
    pub fn to_world(&self, p: [f32; 3]) -> [f32; 3] {
        (DVec3::from(p.map(f64::from)) * self.scale + self.center).as_vec3().to_array()
    }

    /// A point of the world in object space.
    pub fn of_world(&self, p: [f32; 3]) -> [f32; 3] {
        ((DVec3::from(p.map(f64::from)) - self.center) / self.scale).as_vec3().to_array()
    }
}
