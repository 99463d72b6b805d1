//! What quickstarts of several stages share: their folder, and how their progress is shown.

use crate::terminal::{Progress, ShareShown};
use diorama_data::DataError;
use diorama_pipelines::Result;
use diorama_pipelines::run::stages::Listeners;
use std::cell::RefCell;
use std::path::Path;

/// Prepares the folder of a quickstart, of which the subfolder `mark` is a sign; `force` removes an earlier one.
///
/// # Errors
/// When the folder holds something else, or cannot be removed.
pub fn begin(out: &Path, mark: &str, force: bool) -> Result<()> {
    let is_ours = out.join(mark).is_dir();
    if out.is_dir() && !is_ours && out.read_dir().map_err(DataError::io(out, "list"))?.next().is_some() {
        return Err(DataError::input(out, "is not empty and holds no quickstart; give another --out").into());
    }
    if force && is_ours {
        std::fs::remove_dir_all(out).map_err(DataError::io(out, "remove"))?;
    }
    Ok(())
}

/// Does work whose stages, shares and events of training are shown.
pub fn shown<T>(work: impl FnOnce(Listeners) -> Result<T>) -> Result<T> {
    let (mut progress, shown) = (Progress::new(), RefCell::new(ShareShown::new()));
    let stage = RefCell::new(String::new());
    let listeners = Listeners {
        stage: &mut |name| {
            shown.replace(ShareShown::new()).finish();
            stage.replace(name.to_string());
            eprintln!("{name}");
        },
        share: &mut |share| shown.borrow_mut().show(share, &format!("{}: {:.0} %", stage.borrow(), 100.0 * share)),
        events: &mut |e| progress.event(e),
    };
    let done = work(listeners)?;
    shown.into_inner().finish();
    Ok(done)
}
