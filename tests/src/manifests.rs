//! Kubernetes manifests as typed objects.

use std::path::Path;

use k8s_openapi::Resource;
use serde::de::DeserializeOwned;
use serde_json::Value;

use crate::binaries::sightline;
use crate::city::LIMIT;
use crate::process;

/// The objects of a YAML text.
#[derive(Clone, Debug)]
pub struct Manifests {
    /// Every object, in the order of the text.
    pub objects: Vec<Value>,
}

impl Manifests {
    /// Reads a text of YAML documents.
    ///
    /// # Panics
    /// When it is no YAML.
    #[must_use]
    pub fn parse(text: &str) -> Self {
        let objects = serde_saphyr::from_multiple::<Value>(text);
        Self { objects: objects.unwrap_or_else(|e| panic!("{e}\n{text}")) }
    }

    /// What `sightline k8s render` prints with these flags.
    ///
    /// # Panics
    /// When it fails.
    #[must_use]
    pub fn render(flags: &[&str]) -> Self {
        let mut command = sightline(["k8s", "render"]);
        Self::parse(&process::run(command.args(flags), LIMIT).success().stdout)
    }

    /// All objects of a type.
    ///
    /// # Panics
    /// When one of them is not of its form.
    #[must_use]
    pub fn all<T: Resource + DeserializeOwned>(&self) -> Vec<T> {
        let is_meant = |o: &&Value| o["kind"] == T::KIND && o["apiVersion"] == T::API_VERSION;
        let read = |object: &Value| {
            serde_json::from_value(object.clone())
                .unwrap_or_else(|e| panic!("{}: {e}\n{object:#}", T::KIND))
        };
        self.objects.iter().filter(is_meant).map(read).collect()
    }

    /// Objects of a kind that has no type here.
    pub fn of_kind(&self, kind: &str) -> impl Iterator<Item = &Value> {
        self.objects.iter().filter(move |object| object["kind"] == kind)
    }

    /// Writes the objects as one file that YAML readers read: JSON, a document a line.
    ///
    /// # Panics
    /// When the file cannot be written.
    pub fn write(&self, path: &Path) {
        let texts: Vec<String> = self.objects.iter().map(Value::to_string).collect();
        std::fs::write(path, texts.join("\n---\n")).expect("a file can be written");
    }
}
