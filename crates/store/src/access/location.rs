//! Locations as text: what may be shown of them.
//!
//! A URL can carry secrets: a password, the signature of a shared access token. What is shown, sent to
//! workers, or stored is [`redacted`].

use std::path::PathBuf;

/// What stands in place of a secret.
const HIDDEN: &str = "***";

/// Schemes whose user part is the name of a container.
const CONTAINER_AT_ACCOUNT: [&str; 2] = ["abfs", "abfss"];

/// True for text that names a place by URL; anything else is a path.
#[must_use]
pub fn is_url(location: &str) -> bool {
    location.split_once("://").is_some_and(|(scheme, _)| {
        scheme.starts_with(|c: char| c.is_ascii_alphabetic())
            && scheme.chars().all(|c| c.is_ascii_alphanumeric() || "+-.".contains(c))
    })
}

/// The path that a location names on this machine: itself, or that of a `file://` URL.
#[must_use]
pub fn local_path(location: &str) -> Option<PathBuf> {
    if !is_url(location) {
        return Some(PathBuf::from(location));
    }
    let url = url::Url::parse(location).ok().filter(|url| url.scheme() == "file")?;
    url.to_file_path().ok()
}

/// The key of a file that lies at `relative`, a path with `/`, from the folder of `key`; `None` when that
/// is outside the bucket.
#[must_use]
pub fn key_beside(key: &str, relative: &str) -> Option<String> {
    let mut parts: Vec<&str> = key.split('/').collect();
    parts.pop();
    if relative.starts_with('/') {
        return None;
    }
    for part in relative.split('/') {
        match part {
            "" | "." => {}
            ".." => _ = parts.pop()?,
            name => parts.push(name),
        }
    }
    Some(parts.join("/"))
}

/// A location as it may be shown and stored: without user, password, query and fragment. Paths stay as
/// they are.
#[must_use]
pub fn redacted(location: &str) -> String {
    if !is_url(location) {
        return location.to_owned();
    }
    let Some((scheme, rest)) = location.split_once("://") else { return location.to_owned() };
    let rest = rest.split(['?', '#']).next().unwrap_or_default();
    // A password may hold a slash, and a key an @: where both could be, more is hidden than has to be.
    let authority = rest.split('/').next().unwrap_or_default();
    match rest.rsplit_once('@') {
        Some((user, host)) if is_container(scheme, user) => format!("{scheme}://{user}@{host}"),
        Some((user, host)) if authority.contains('@') || user.contains(':') => {
            format!("{scheme}://{HIDDEN}@{host}")
        }
        _ => format!("{scheme}://{rest}"),
    }
}

/// True for the user part of `abfss://container@account...`, which is no secret.
pub(super) fn is_container(scheme: &str, user: &str) -> bool {
    CONTAINER_AT_ACCOUNT.contains(&scheme) && !user.contains(':')
}

/// The location of the bucket that holds `key`, whose own location is given.
pub(super) fn root_of(location: &str, key: &str) -> String {
    // The key is percent-decoded, so its parts are counted instead of compared.
    let parts = key.split('/').count();
    let mut root = location.trim_end_matches('/');
    for _ in 0..parts {
        root = root.rsplit_once('/').map_or(root, |(folder, _)| folder);
    }
    root.to_owned()
}

/// `text` without queries of URLs and without any of `secrets`.
pub(super) fn cleaned(text: &str, secrets: &[String]) -> String {
    let mut out = String::with_capacity(text.len());
    let mut rest = text;
    while let Some(at) = rest.find("://") {
        let end = rest[at..]
            .find(|c: char| c.is_whitespace() || "\"'<>()`".contains(c))
            .map_or(rest.len(), |end| at + end);
        let url = &rest[at..end];
        let (authority, _) = url[3..].split_at(url[3..].find(['/', '?']).unwrap_or(url.len() - 3));
        out.push_str(&rest[..at]);
        match authority.rsplit_once('@') {
            // The password may hold anything; what is before it is kept.
            Some((user, _)) if user.contains(':') => {
                let shown = url.replacen(user, HIDDEN, 1);
                out.push_str(shown.split('?').next().unwrap_or_default());
            }
            _ => out.push_str(url.split('?').next().unwrap_or_default()),
        }
        rest = &rest[end..];
    }
    out.push_str(rest);
    for secret in secrets.iter().filter(|secret| !secret.is_empty()) {
        out = out.replace(secret.as_str(), HIDDEN);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_secret_is_left_of_a_url() {
        let cases = [
            ("s3://bucket/a/b", "s3://bucket/a/b"),
            ("s3://AKIA:SECRET@bucket/a", "s3://***@bucket/a"),
            ("s3://AKIA@bucket/a", "s3://***@bucket/a"),
            ("az://box/a?sv=1&sig=SECRET", "az://box/a"),
            (
                "https://acc.blob.core.windows.net/box?sig=SECRET#SECRET",
                "https://acc.blob.core.windows.net/box",
            ),
            ("abfss://box@acc.dfs.core.windows.net/a", "abfss://box@acc.dfs.core.windows.net/a"),
            (
                "abfss://box:SECRET@acc.dfs.core.windows.net/a",
                "abfss://***@acc.dfs.core.windows.net/a",
            ),
            ("s3://us@er:SE/CRET@bucket/a", "s3://***@bucket/a"),
            ("a folder/with?odd#names@x", "a folder/with?odd#names@x"),
        ];
        for (given, shown) in cases {
            assert_eq!(redacted(given), shown, "{given}");
        }
    }

    #[test]
    fn messages_lose_queries_and_secrets() {
        let secrets = ["TOPSECRET".to_owned(), String::new()];
        let text = "GET http://h/a?sig=abc in 1 s, TOPSECRET (https://u:pw@h/b?c) and \"s3://x/y\"";
        let shown = cleaned(text, &secrets);
        assert_eq!(shown, "GET http://h/a in 1 s, *** (https://***@h/b) and \"s3://x/y\"");
    }

    #[test]
    fn neighbours_of_a_key_stay_in_its_bucket() {
        let beside = |key, relative| key_beside(key, relative);
        assert_eq!(beside("a/b/city.glb", "x.bin").as_deref(), Some("a/b/x.bin"));
        assert_eq!(beside("a/b/city.glb", "../t/./x.csv").as_deref(), Some("a/t/x.csv"));
        assert_eq!(beside("city.glb", "x.bin").as_deref(), Some("x.bin"));
        assert_eq!(beside("city.glb", "../x.bin"), None);
        assert_eq!(beside("a/city.glb", "/etc/passwd"), None);
    }

    #[test]
    fn paths_are_no_urls() {
        assert!(is_url("s3://a") && is_url("file:///a"));
        assert!(!is_url("a/b") && !is_url("://a") && !is_url("C:\\a") && !is_url("a b://c"));
    }

    #[test]
    fn the_root_of_an_object_is_its_bucket() {
        assert_eq!(root_of("s3://bucket/a%20b/c.glb", "a b/c.glb"), "s3://bucket");
        assert_eq!(
            root_of("https://s3.x.amazonaws.com/bucket/c", "c"),
            "https://s3.x.amazonaws.com/bucket"
        );
    }
}
