//! Objects as YAML documents, on stdout or as files of a kustomization.

use std::path::Path;

use serde::Serialize;
use serde_saphyr::SerializerOptions;

use crate::commands::write_whole;
use crate::failure::{Failure, Kind, Result};

/// First line of a file that was rendered.
const HEADER: &str = "# Written by `sightline k8s render`; see k8s/README.md.\n";

/// One object.
#[derive(Debug)]
pub struct Document {
    /// Name of its file, without the extension.
    pub file: String,
    yaml: String,
}

impl Document {
    /// An object as YAML.
    pub fn of(file: impl Into<String>, object: &impl Serialize) -> Result<Self> {
        Ok(Self { file: file.into(), yaml: to_yaml(object)? })
    }
}

fn to_yaml(object: &impl Serialize) -> Result<String> {
    let mut options = SerializerOptions::default();
    // Long arguments stay on one line; only texts with line breaks become blocks.
    options.folded_wrap_chars = usize::MAX;
    serde_saphyr::to_string_with_options(object, options)
        .map_err(|error| Failure::new(Kind::Defect, format!("an object is no YAML: {error}")))
}

/// All objects as one text.
pub fn to_text(documents: &[Document]) -> Result<String> {
    let texts: Vec<&str> = documents.iter().map(|d| d.yaml.as_str()).collect();
    Ok(texts.join("---\n"))
}

/// One file an object, and a kustomization of them.
pub fn write_folder(documents: &[Document], folder: &Path) -> Result<()> {
    std::fs::create_dir_all(folder)
        .map_err(|error| Failure::io(Kind::Store, "make the folder", folder, &error))?;
    let mut kustomization = format!(
        "{HEADER}apiVersion: kustomize.config.k8s.io/v1beta1\nkind: Kustomization\nresources:\n"
    );
    for document in documents {
        let name = format!("{}.yaml", document.file);
        write(&folder.join(&name), &format!("{HEADER}{}", document.yaml))?;
        kustomization.push_str(&format!("- {name}\n"));
    }
    write(&folder.join("kustomization.yaml"), &kustomization)
}

fn write(path: &Path, text: &str) -> Result<()> {
    write_whole(path, |partial| {
        std::fs::write(partial, text)
            .map_err(|error| Failure::io(Kind::Store, "write", path, &error))
    })
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;

    #[test]
    fn texts_that_look_like_something_else_are_quoted() {
        let texts = ["true", "yes", "on", "n", "null", "~", "012", "1e3", "1:30", "0x1f", "- a"];
        for text in texts {
            let yaml = to_yaml(&BTreeMap::from([("key", text)])).unwrap();
            assert!(yaml.contains('"') || yaml.contains('\''), "{yaml}");
        }
        let plain = to_yaml(&BTreeMap::from([("key", "0.0.0.0:7070")])).unwrap();
        assert_eq!(plain.replace(['"', '\''], ""), "key: 0.0.0.0:7070\n");
    }

    #[test]
    fn a_configuration_stays_readable() {
        let toml = "[region]\nrectangles = [[1.0]]\n\n[scene]\nsee_through = [\"*glass*\"]\n";
        let yaml = to_yaml(&BTreeMap::from([("bake.toml", toml)])).unwrap();
        assert!(yaml.starts_with("bake.toml: |\n"), "{yaml}");
        assert!(yaml.contains("  see_through = [\"*glass*\"]\n"), "{yaml}");
    }

    #[test]
    fn long_lines_are_not_folded() {
        let long = "word ".repeat(60);
        let yaml = to_yaml(&BTreeMap::from([("key", long.trim())])).unwrap();
        assert_eq!(yaml.lines().count(), 1, "{yaml}");
    }
}
