//! A small file system of its own, to be filled.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// Size, MiB: several times what the bake of the street writes.
const SIZE_MIB: u32 = 48;
const BLOCK_BYTES: usize = 4096;

/// A mounted tmpfs; unmounted when dropped.
pub(super) struct Disk {
    folder: PathBuf,
}

impl Disk {
    /// Mounts it on an empty folder; `None` where this process may not.
    pub fn mount(folder: &Path) -> Option<Self> {
        let mut mount = Command::new("mount");
        mount.args(["-t", "tmpfs", "-o", &format!("size={SIZE_MIB}m"), "sightline-chaos"]);
        succeeds(mount.arg(folder)).then(|| Self { folder: folder.to_owned() })
    }

    /// Takes every block that is left.
    pub fn fill(&self) {
        let mut filler = std::fs::File::create(self.filler()).expect("a file can be made");
        let block = [0_u8; BLOCK_BYTES];
        while filler.write_all(&block).is_ok() {}
    }

    /// Gives the blocks back. Nothing happens when they are free.
    pub fn free(&self) {
        let _ = std::fs::remove_file(self.filler());
    }

    fn filler(&self) -> PathBuf {
        self.folder.join("filler")
    }
}

impl Drop for Disk {
    fn drop(&mut self) {
        // Lazily: a process that is ending may still hold a file. It goes when the last one does.
        succeeds(Command::new("umount").arg("--lazy").arg(&self.folder));
    }
}

fn succeeds(command: &mut Command) -> bool {
    command.stdout(Stdio::null()).stderr(Stdio::null()).status().is_ok_and(|s| s.success())
}
