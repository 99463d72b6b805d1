pub fn find_model(_: &std::path::Path) -> Option<std::path::PathBuf> { None } pub fn read(_: &std::path::Path) -> crate::Result<crate::import::Imported> { todo!() }
