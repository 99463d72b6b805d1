//! Distant light as users describe it: an environment map, a clear sky, or spherical harmonics, turned and scaled.

use crate::error::{PipelineError, Result};
use diorama_data::{DataError, environment, sh_text};
use diorama_geom::daylight::{Daylight, Sun};
use diorama_geom::environment::Environment;
use diorama_geom::glam::DVec3;
use diorama_geom::sky::Sky;
use std::path::{Path, PathBuf};

/// Rows of maps that are computed.
const ROWS: usize = 128;
/// Angular diameter of a sun that is added by hand, in radians.
const SUN: f64 = Sky::SUN_DIAMETER;

/// Source of light before it is turned and scaled.
#[derive(Clone, Debug, PartialEq)]
pub enum Source {
    /// An environment map, or nine rows of spherical harmonics and perhaps a sun.
    File(PathBuf),
    /// A clear sky: elevation of its sun above the horizon and rotation from the center of the map to the right, in degrees.
    Sky { elevation: f64, rotation: f64 },
    /// The same radiance from everywhere.
    Uniform(f64),
}

/// Light of a picture.
#[derive(Clone, Debug, PartialEq)]
pub struct LightOptions {
    pub source: Source,
    /// Turn about the vertical in degrees, counterclockwise from above.
    pub rotate_deg: f64,
    pub strength: f64,
    /// A sun besides: azimuth from the center of the map to the right and elevation in degrees, and the irradiance of a surface that faces it.
    pub sun: Option<[f64; 3]>,
}

impl LightOptions {
    /// Light of a source as it is.
    pub fn of(source: Source) -> LightOptions {
        LightOptions { source, rotate_deg: 0.0, strength: 1.0, sun: None }
    }

    /// The light, and notes about what was mended in its file.
    ///
    /// # Errors
    /// When the file is no light, or a number makes no sense.
    pub fn read(&self) -> Result<(Daylight, Vec<String>)> {
        if !(self.strength.is_finite() && self.strength >= 0.0) {
            return Err(PipelineError::Usage(format!("strength {}: must be 0 or more", self.strength)));
        }
        let mut notes = Vec::new();
        let light = match &self.source {
            Source::File(path) if is_text(path) => {
                let text = sh_text::read(path)?;
                let sun = text.sun.map(|(direction, irradiance)| Sun { direction, diameter: SUN, irradiance });
                Daylight { sun, ..Daylight::of(text.light.environment(ROWS)) }
            }
            Source::File(path) => {
                let read = environment::read(path)?;
                notes.extend(read.notes);
                Daylight::of(read.environment)
            }
            Source::Sky { elevation, rotation } => {
                if !(-18.0..=90.0).contains(elevation) {
                    return Err(PipelineError::Usage(format!("sky elevation {elevation}: must lie between -18 and 90 degrees")));
                }
                Daylight::clear(&Sky::clear(elevation.to_radians(), rotation.to_radians()), ROWS)
            }
            Source::Uniform(radiance) => Daylight::of(Environment::uniform([*radiance; 3], 8)),
        };
        let mut light = light.turned(self.rotate_deg.to_radians(), self.strength);
        if let Some([azimuth, elevation, power]) = self.sun {
            if light.sun.is_some() {
                return Err(PipelineError::Usage("the light has a sun of its own; leave out the second one".into()));
            }
            let (up, level) = elevation.to_radians().sin_cos();
            let (right, ahead) = azimuth.to_radians().sin_cos();
            light.sun = Some(Sun { direction: DVec3::new(level * right, level * ahead, up), diameter: SUN, irradiance: [power; 3] });
        }
        Ok((light, notes))
    }
}

fn is_text(path: &Path) -> bool {
    path.extension().is_some_and(|e| e.eq_ignore_ascii_case("txt"))
}

impl std::str::FromStr for Source {
    type Err = String;

    /// `sky:ELEVATION,ROTATION`, `uniform`, or a file.
    fn from_str(s: &str) -> std::result::Result<Source, String> {
        if s == "uniform" {
            return Ok(Source::Uniform(1.0));
        }
        let Some(sky) = s.strip_prefix("sky:") else { return Ok(Source::File(s.into())) };
        let numbers: Vec<f64> = sky.split(',').filter_map(|n| n.trim().parse().ok()).collect();
        match numbers[..] {
            [elevation, rotation] => Ok(Source::Sky { elevation, rotation }),
            _ => Err(format!("{s:?}: expected sky:ELEVATION,ROTATION in degrees, for example sky:30,120")),
        }
    }
}

/// Refuses a file that is not there, naming the field that gives it.
pub(crate) fn require_file(path: &Path, field: &str) -> Result<()> {
    if path.is_file() { Ok(()) } else { Err(DataError::input(path, format!("{field}: there is no such file")).into()) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sources_are_parsed_and_wrong_ones_say_what_is_expected() {
        assert_eq!("sky:30,120".parse(), Ok(Source::Sky { elevation: 30.0, rotation: 120.0 }));
        assert_eq!("uniform".parse(), Ok(Source::Uniform(1.0)));
        assert_eq!("a b.hdr".parse(), Ok(Source::File("a b.hdr".into())));
        assert!("sky:30".parse::<Source>().unwrap_err().contains("sky:30,120"));
    }

    #[test]
    fn suns_stand_where_they_are_said_to() {
        let mut options = LightOptions { sun: Some([90.0, 30.0, 2.0]), ..LightOptions::of(Source::Uniform(1.0)) };
        let sun = options.read().unwrap().0.sun.unwrap();
        assert!((sun.direction - DVec3::new(0.75f64.sqrt(), 0.0, 0.5)).length() < 1e-12 && sun.irradiance == [2.0; 3]);
        options.source = Source::Sky { elevation: 20.0, rotation: 0.0 };
        assert!(options.read().unwrap_err().is_input());
        (options.sun, options.strength) = (None, -1.0);
        assert!(options.read().unwrap_err().to_string().contains("strength -1"));
    }
}
