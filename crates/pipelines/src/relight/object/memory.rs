//! Memory that training needs, estimated before it begins, so that a size too large is refused at once.

use super::config::{CHANNELS, Config};
use crate::error::{PipelineError, Result};
use crate::run::memory::size;

/// Bytes of a number.
const NUMBER: f64 = 4.0;
/// A trained number has a value, a gradient and two moments.
const TRAINED: f64 = 4.0 * NUMBER;
/// Bytes of a tetrahedron with its edges; of a pixel of a view with all that its gradient needs; of a ray of a vertex.
const TETRAHEDRON: f64 = 120.0;
const PIXEL: f64 = 1500.0;
const RAY: f64 = 8.0;
/// Bytes of a pixel while the first surface is carved: its color, the cell that it shows, and what it shows of that.
const CARVED: f64 = 64.0;
/// Vertices of a surface over the squared number of cells, and rays of each that lie above it.
const VERTICES: f64 = 12.0;
const RAYS: f64 = 768.0;

/// Bytes of the three stages besides the photographs, for views of `pixels`.
fn stages(config: &Config, pixels: usize) -> [f64; 3] {
    let cells = config.grid.cells as f64;
    let m = &config.material;
    let views = config.run.batch as f64 * pixels as f64 * PIXEL;
    let fine = (config.run.samples * config.run.samples) as f64 * views;
    let table = m.levels as f64 * 2.0 * (1u64 << m.log2_size) as f64 * TRAINED;
    let topology = 12.0 * cells.powi(3) * TETRAHEDRON + 2.0 * cells.powi(3) * 7.0 * TRAINED + table + views;
    // Copies of the textures with their coarser levels: looked up, their gradient, and that of one view.
    let texels = (m.texture * m.texture * CHANNELS) as f64;
    let textured = texels * (TRAINED + 4.0 * NUMBER) + fine;
    [topology, textured, textured + VERTICES * cells * cells * RAYS * RAY]
}

/// Refuses sizes that do not fit into the memory that is `available`.
///
/// # Errors
/// Names the stage, its size, and a smaller setting.
pub fn check(config: &Config, photographs: usize, pixels: usize, available: Option<u64>) -> Result<()> {
    let Some(available) = available else { return Ok(()) };
    let kept = photographs as f64 * pixels as f64 * 5.0 * NUMBER;
    let [topology, textured, traced] = stages(config, pixels);
    let is_carved = config.grid.start == "carved" && config.topology_steps() > 0;
    let carving = if is_carved { photographs as f64 * pixels as f64 * CARVED } else { 0.0 };
    let asked = [
        ("the photographs", 0.0, "reduce them with --set data.downscale=2".to_string()),
        ("the first surface (carving)", carving, "use --set grid.start=hull".into()),
        ("the first stage (tetrahedra)", topology, format!("use --set grid.cells={}", (config.grid.cells / 2).max(4))),
        ("the second stage (textures)", textured, format!("use --texture {}", (config.material.texture / 2).max(64))),
        ("the third stage (traced light)", if config.run.traced_steps > 0 { traced } else { 0.0 }, "leave out --mc".into()),
    ];
    match asked.into_iter().find(|(_, bytes, _)| kept + bytes > available as f64) {
        None => Ok(()),
        Some((stage, bytes, cure)) => Err(PipelineError::Memory(format!(
            "out of memory: {stage} would take about {}, {} are free; {cure}",
            size((kept + bytes) as u64),
            size(available)
        ))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::relight::object::config::Preset;

    #[test]
    fn the_stage_that_does_not_fit_is_named_with_a_smaller_setting() {
        let mut config = Config::new(Preset::Fast, "d".into());
        let refusal = |c: &Config, photographs: usize, free: u64| {
            let e = check(c, photographs, 1 << 16, Some(free << 20)).unwrap_err();
            assert!(e.kind() == "memory" && !e.to_string().contains('\n'), "{e}");
            e.to_string()
        };
        check(&config, 60, 1 << 16, Some(4 << 30)).unwrap();
        check(&config, 60, 1 << 16, None).unwrap();
        let e = refusal(&config, 60_000, 4096);
        assert!(e.contains("photographs") && e.contains("data.downscale=2"), "{e}");
        config.grid.cells = 128;
        let e = refusal(&config, 60, 2048);
        assert!(e.contains("first stage") && e.contains("GiB") && e.contains("grid.cells=64"), "{e}");
        (config.grid.cells, config.material.texture) = (26, 8192);
        let e = refusal(&config, 60, 4096);
        assert!(e.contains("second stage") && e.contains("--texture 4096"), "{e}");
        (config.grid.cells, config.material.texture, config.material.levels, config.run.traced_steps) = (30, 512, 1, 10);
        config.run.samples = 1;
        let e = refusal(&config, 60, 280);
        assert!(e.contains("carving") && e.contains("grid.start=hull"), "{e}");
        config.grid.start = "hull".into();
        let e = refusal(&config, 60, 280);
        assert!(e.contains("third stage") && e.contains("--mc"), "{e}");
    }
}
