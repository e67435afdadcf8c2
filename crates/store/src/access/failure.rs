//! What a backend reports, as an error that says what to do and shows nothing secret.
//!
//! Servers explain themselves in XML, `<Error><Code>...</Code><Message>...</Message></Error>`; of that
//! only code and message are shown. The code decides where the HTTP status alone does not: a missing
//! bucket and a missing object are both 404.

use std::error::Error;

use object_store::client::HttpError;

use super::BakeStore;
use super::location::cleaned;
use crate::StoreError;

/// Codes of S3, Google Cloud Storage and Azure for a bucket or container that does not exist.
const NO_BUCKET: [&str; 3] = ["NoSuchBucket", "ContainerNotFound", "ContainerBeingDeleted"];

/// Longest message of a server that is shown, characters.
const MESSAGE_CHARS_MAX: usize = 300;

/// What a backend reported, for people.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
struct Reported(String);

/// The error of a request for `key`.
pub(super) fn explain(store: &BakeStore, key: &str, error: object_store::Error) -> StoreError {
    use object_store::Error as E;
    let text = cleaned(&error.to_string(), &store.secrets);
    let code = between(&text, "<Code>", "</Code>");
    if code.is_some_and(|code| NO_BUCKET.contains(&code)) {
        return StoreError::BadLocation {
            location: store.location.clone(),
            problem: "there is no such bucket or container; create it, or correct the name".into(),
        };
    }
    let key = key.to_owned();
    let shown = |hint: &str| Box::new(Reported(summary(&text, &error) + hint));
    match &error {
        E::NotFound { .. } => StoreError::NotFound { key, location: store.location.clone() },
        E::PermissionDenied { .. } | E::Unauthenticated { .. } => {
            StoreError::Refused { key, source: shown(store.access_help) }
        }
        E::InvalidPath { .. }
        | E::NotSupported { .. }
        | E::NotImplemented { .. }
        | E::UnknownConfigurationKey { .. } => StoreError::Refused { key, source: shown("") },
        _ if refused_by_the_system(&error) => StoreError::Refused { key, source: shown("") },
        // The client is set up to speak https only.
        _ if text.contains("URL scheme is not allowed") => StoreError::Refused {
            key,
            source: shown(
                "; the server's address is http: allow it with AWS_ALLOW_HTTP=true, \
                 AZURE_ALLOW_HTTP=true or GOOGLE_ALLOW_HTTP=true",
            ),
        },
        _ if is_unreachable(&error) => StoreError::Unavailable {
            key,
            source: shown("; check the network, and the server's address in the environment"),
        },
        _ => StoreError::Unavailable { key, source: shown("") },
    }
}

/// The server's code and message, or the last cause.
fn summary(text: &str, error: &object_store::Error) -> String {
    if let Some(code) = between(text, "<Code>", "</Code>") {
        let message = between(text, "<Message>", "</Message>").unwrap_or_default();
        let message: String =
            message.lines().next().unwrap_or_default().chars().take(MESSAGE_CHARS_MAX).collect();
        return format!("the server says {code}: {message}");
    }
    // Of a failed connection the last cause says most; of all else the whole.
    match chain(error).last() {
        Some(last) if is_unreachable(error) => {
            format!("the server cannot be reached: {last}")
        }
        _ if text.chars().count() > 2 * MESSAGE_CHARS_MAX => {
            text.chars().take(2 * MESSAGE_CHARS_MAX).chain("...".chars()).collect()
        }
        _ => text.to_owned(),
    }
}

fn between<'a>(text: &'a str, start: &str, end: &str) -> Option<&'a str> {
    let inner = text.split_once(start)?.1;
    Some(inner.split_once(end)?.0)
}

fn chain<'a>(error: &'a (dyn Error + 'static)) -> impl Iterator<Item = &'a (dyn Error + 'static)> {
    std::iter::successors(Some(error), |e: &&'a (dyn Error + 'static)| (*e).source())
}

fn is_unreachable(error: &(dyn Error + 'static)) -> bool {
    use object_store::client::HttpErrorKind as K;
    chain(error)
        .filter_map(|e| e.downcast_ref::<HttpError>())
        .any(|e| matches!(e.kind(), K::Connect | K::Timeout))
}

/// True when an I/O error below `error` will not pass by itself.
fn refused_by_the_system(error: &(dyn Error + 'static)) -> bool {
    use std::io::ErrorKind as K;
    chain(error).filter_map(|e| e.downcast_ref::<std::io::Error>()).any(|e| {
        matches!(
            e.kind(),
            K::PermissionDenied | K::ReadOnlyFilesystem | K::NotADirectory | K::IsADirectory
        )
    })
}
