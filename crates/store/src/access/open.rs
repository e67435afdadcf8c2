//! From a location to a backend: folders, S3, Google Cloud Storage, Azure Blob Storage.
//!
//! Credentials, endpoints and client options come from the variables that the clouds' own tools use
//! (`AWS_*`, `GOOGLE_*`, `AZURE_*`; `object_store` documents all of them). TLS is rustls with ring.
//!
//! A cloud's machines get credentials from a metadata server. Elsewhere a request to it waits for a
//! minute and then complains about an address nobody has heard of; so where the environment has no
//! credentials that server is looked for first, for a moment, and what is missing is said at once.

use std::net::{SocketAddr, TcpStream, ToSocketAddrs};
use std::path::Path as FilePath;
use std::sync::{Arc, Once};
use std::time::Duration;

use object_store::aws::{AmazonS3Builder, AmazonS3ConfigKey as S3};
use object_store::azure::{AzureConfigKey as Azure, MicrosoftAzureBuilder};
use object_store::gcp::{GoogleCloudStorageBuilder, GoogleConfigKey as Google};
use object_store::local::LocalFileSystem;
use object_store::path::Path;
use object_store::{BackoffConfig, ClientConfigKey, ObjectStore, ObjectStoreScheme, RetryConfig};
use url::Url;

use super::BakeStore;
use super::location::{cleaned, is_container, is_url, redacted};
use crate::{Result, StoreError};

/// Tries of a request after the first. With the pauses below about 20 s go by before a server that
/// refuses connections is given up; coordinators and workers have retries of their own above these.
const RETRIES_MAX: usize = 8;
/// First and longest pause between two tries: the second keeps a herd of workers off a server that has
/// just come back.
const PAUSE_MIN: Duration = Duration::from_millis(100);
const PAUSE_MAX: Duration = Duration::from_secs(8);
/// No try starts later than this after the first: requests are signed once, and signatures expire
/// after five minutes.
const RETRY_TIME_MAX: Duration = Duration::from_secs(120);
/// Longest time of one request, its bytes included. The largest, a dataset file of 128 MiB, needs
/// 1.1 MB/s then. A request that is lost without a word costs this much.
const REQUEST_TIME: &str = "120 seconds";
/// Longest time to connect.
const CONNECT_TIME: &str = "5 seconds";
/// How long a metadata server is looked for. It answers within a millisecond where there is one.
const METADATA_TIME: Duration = Duration::from_millis(700);

const S3_HELP: &str = "; check AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY and AWS_SESSION_TOKEN, \
    AWS_REGION, and that they may read, write, list and delete there";
const AZURE_HELP: &str = "; check AZURE_STORAGE_ACCOUNT_NAME and AZURE_STORAGE_ACCOUNT_KEY or \
    AZURE_STORAGE_SAS_TOKEN, and that they may read, write, list and delete there";
const GOOGLE_HELP: &str = "; check GOOGLE_APPLICATION_CREDENTIALS or GOOGLE_SERVICE_ACCOUNT, and \
    that the account may read, write, list and delete there";

/// A URL in the making of a store.
struct Opening<'a> {
    location: &'a str,
    /// Without secrets.
    url: Url,
    /// The query: a shared access signature of Azure.
    query: Option<String>,
}

/// Opens a location; makes a folder when `make` says so.
pub(super) fn open(location: &str, make: bool) -> Result<BakeStore> {
    if !is_url(location) {
        return open_folder(location, FilePath::new(location), make);
    }
    let url = Url::parse(location).map_err(|e| bad(location, e.to_string()))?;
    let (scheme, prefix) =
        ObjectStoreScheme::parse(&url).map_err(|_| bad(location, KNOWN_URLS.to_owned()))?;
    if let ObjectStoreScheme::Local = scheme {
        let folder = url.to_file_path().map_err(|()| bad(location, "it names no file".into()))?;
        return open_folder(location, &folder, make);
    }
    let opening = Opening::new(location, url)?;
    let (objects, secrets, access_help) = match scheme {
        ObjectStoreScheme::AmazonS3 => opening.s3()?,
        ObjectStoreScheme::GoogleCloudStorage => opening.google()?,
        ObjectStoreScheme::MicrosoftAzure => opening.azure()?,
        _ => return Err(bad(location, KNOWN_URLS.to_owned())),
    };
    Ok(BakeStore {
        objects,
        prefix,
        location: redacted(location),
        secrets: secrets.into(),
        access_help,
        is_remote: true,
    })
}

const KNOWN_URLS: &str = "give a folder, or a URL such as s3://bucket/prefix, gs://bucket/prefix, \
    az://container/prefix or file:///folder. The address of a server of your own goes into \
    AWS_ENDPOINT_URL or AZURE_STORAGE_ENDPOINT";

fn bad(location: &str, problem: String) -> StoreError {
    StoreError::BadLocation { location: redacted(location), problem }
}

fn open_folder(location: &str, folder: &FilePath, make: bool) -> Result<BakeStore> {
    if make {
        std::fs::create_dir_all(folder).map_err(|e| bad(location, e.to_string()))?;
    }
    if !folder.is_dir() {
        return Err(bad(location, "there is no such folder".into()));
    }
    let files =
        LocalFileSystem::new_with_prefix(folder).map_err(|e| bad(location, e.to_string()))?;
    Ok(BakeStore::new(Arc::new(files.with_fsync(true)), Path::default(), location))
}

type Opened = (Arc<dyn ObjectStore>, Vec<String>, &'static str);

impl<'a> Opening<'a> {
    fn new(location: &'a str, mut url: Url) -> Result<Self> {
        use_ring();
        let has_user = !url.username().is_empty() && !is_container(url.scheme(), url.username());
        if has_user || url.password().is_some() {
            let problem = "it holds a user or a password; give credentials in the environment";
            return Err(bad(location, problem.into()));
        }
        let query = url.query().map(str::to_owned);
        url.set_query(None);
        url.set_fragment(None);
        Ok(Self { location, url, query })
    }

    fn refuse_query(&self) -> Result<()> {
        if self.query.is_none() {
            return Ok(());
        }
        let problem = "it has a query (?...); give credentials and options in the environment";
        Err(bad(self.location, problem.into()))
    }

    fn s3(&self) -> Result<Opened> {
        self.refuse_query()?;
        let mut builder =
            AmazonS3Builder::from_env().with_url(self.url.as_str()).with_retry(retries());
        for (key, value) in client_defaults("AWS_") {
            builder = builder.with_config(S3::Client(key), value);
        }
        let set = |key: S3| builder.get_config_value(&key).filter(|value| !value.is_empty());
        let anonymous = set(S3::SkipSignature).is_some_and(|text| text == "true");
        let given = [
            S3::AccessKeyId,
            S3::WebIdentityTokenFile,
            S3::ContainerCredentialsRelativeUri,
            S3::ContainerCredentialsFullUri,
            S3::MetadataEndpoint,
        ];
        if !anonymous && !given.into_iter().any(|key| set(key).is_some()) {
            self.expect_metadata_server(
                "169.254.169.254:80",
                "AWS_ACCESS_KEY_ID and \
                AWS_SECRET_ACCESS_KEY, and AWS_ENDPOINT_URL for a server other than Amazon's",
            )?;
        }
        let secrets: Vec<String> =
            [S3::SecretAccessKey, S3::Token].into_iter().filter_map(set).collect();
        Ok((Arc::new(self.built(builder.build(), &secrets)?), secrets, S3_HELP))
    }

    fn azure(&self) -> Result<Opened> {
        let mut builder =
            MicrosoftAzureBuilder::from_env().with_url(self.url.as_str()).with_retry(retries());
        for (key, value) in client_defaults("AZURE_") {
            builder = builder.with_config(Azure::Client(key), value);
        }
        if let Some(signature) = &self.query {
            builder = builder.with_config(Azure::SasKey, signature);
        }
        let set = |key: Azure| builder.get_config_value(&key).filter(|value| !value.is_empty());
        let is_true = |key: Azure| set(key).is_some_and(|text| text == "true");
        let given = [
            Azure::AccessKey,
            Azure::SasKey,
            Azure::Token,
            Azure::ClientId,
            Azure::MsiEndpoint,
            Azure::CredentialType,
        ];
        let anonymous = [Azure::SkipSignature, Azure::UseEmulator, Azure::UseAzureCli];
        if !anonymous.into_iter().any(is_true) && !given.into_iter().any(|key| set(key).is_some()) {
            self.expect_metadata_server(
                "169.254.169.254:80",
                "AZURE_STORAGE_ACCOUNT_NAME and \
                AZURE_STORAGE_ACCOUNT_KEY or AZURE_STORAGE_SAS_TOKEN",
            )?;
        }
        let secret_keys = [Azure::AccessKey, Azure::SasKey, Azure::Token, Azure::ClientSecret];
        let mut secrets: Vec<String> = secret_keys.into_iter().filter_map(set).collect();
        // The signature alone, as it is and decoded.
        for signature in secrets.clone() {
            let pairs = url::form_urlencoded::parse(signature.as_bytes());
            secrets.extend(pairs.filter(|(k, _)| k == "sig").map(|(_, v)| v.into_owned()));
        }
        Ok((Arc::new(self.built(builder.build(), &secrets)?), secrets, AZURE_HELP))
    }

    fn google(&self) -> Result<Opened> {
        self.refuse_query()?;
        let mut builder =
            GoogleCloudStorageBuilder::from_env().with_url(self.url.as_str()).with_retry(retries());
        for (key, value) in client_defaults("GOOGLE_") {
            builder = builder.with_config(Google::Client(key), value);
        }
        let set = |key: Google| builder.get_config_value(&key).filter(|value| !value.is_empty());
        let anonymous = set(Google::SkipSignature).is_some_and(|text| text == "true");
        let given = [
            Google::ServiceAccount,
            Google::ServiceAccountKey,
            Google::ApplicationCredentials,
            Google::BearerToken,
        ];
        let is_given = given.into_iter().any(|key| set(key).is_some());
        // Where `gcloud auth application-default login` leaves them; `object_store` looks there too.
        let home = std::env::var_os("HOME").map(std::path::PathBuf::from).unwrap_or_default();
        let saved = home.join(".config/gcloud/application_default_credentials.json");
        if !anonymous && !is_given && !saved.is_file() {
            self.expect_metadata_server(
                "metadata.google.internal:80",
                "GOOGLE_APPLICATION_CREDENTIALS to the file of a service account",
            )?;
        }
        let secret_keys = [Google::ServiceAccountKey, Google::BearerToken];
        let secrets: Vec<String> = secret_keys.into_iter().filter_map(set).collect();
        Ok((Arc::new(self.built(builder.build(), &secrets)?), secrets, GOOGLE_HELP))
    }

    fn built<S>(&self, store: object_store::Result<S>, secrets: &[String]) -> Result<S> {
        store.map_err(|e| bad(self.location, cleaned(&e.to_string(), secrets)))
    }

    /// Fails when nobody listens at `server`, where a cloud's machine gets its credentials.
    fn expect_metadata_server(&self, server: &str, variables: &str) -> Result<()> {
        let answers =
            |address: SocketAddr| TcpStream::connect_timeout(&address, METADATA_TIME).is_ok();
        if server.to_socket_addrs().is_ok_and(|mut found| found.any(answers)) {
            return Ok(());
        }
        Err(bad(self.location, format!("there are no credentials for it; set {variables}")))
    }
}

fn retries() -> RetryConfig {
    RetryConfig {
        backoff: BackoffConfig { init_backoff: PAUSE_MIN, max_backoff: PAUSE_MAX, base: 2.0 },
        max_retries: RETRIES_MAX,
        retry_timeout: RETRY_TIME_MAX,
    }
}

/// Client options that the environment does not set, with our values.
fn client_defaults(prefix: &str) -> impl Iterator<Item = (ClientConfigKey, &'static str)> {
    let defaults = [
        (ClientConfigKey::Timeout, "TIMEOUT", REQUEST_TIME),
        (ClientConfigKey::ConnectTimeout, "CONNECT_TIMEOUT", CONNECT_TIME),
    ];
    let is_unset = |name: &str| std::env::var_os(format!("{prefix}{name}")).is_none();
    let ours: Vec<_> = defaults
        .into_iter()
        .filter(|(_, name, _)| is_unset(name))
        .map(|(key, _, value)| (key, value))
        .collect();
    ours.into_iter()
}

/// Makes ring the provider of TLS, unless the program has chosen one.
fn use_ring() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        // An error says that there is a provider already.
        let _ = rustls::crypto::ring::default_provider().install_default();
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ErrorClass;

    #[test]
    fn locations_that_are_no_store_say_what_is() {
        for location in
            ["https://example.com/x", "http://127.0.0.1:1/x", "nonsense://x", "ftp://a/b"]
        {
            let error = open(location, true).unwrap_err();
            assert_eq!(error.class(), ErrorClass::FixInput, "{error}");
            assert!(error.to_string().contains("s3://bucket/prefix"), "{error}");
        }
    }

    #[test]
    fn secrets_in_urls_are_refused_without_repeating_them() {
        for location in [
            "s3://key:SECRET@bucket/x",
            "gs://bucket/x?token=SECRET",
            "s3://bucket/x?X-Amz-Signature=SECRET",
            "abfss://box:SECRET@acc.dfs.core.windows.net/x",
        ] {
            let error = open(location, true).unwrap_err();
            assert_eq!(error.class(), ErrorClass::FixInput, "{error}");
            let shown = format!("{error} {error:?}");
            assert!(shown.contains("environment") && !shown.contains("SECRET"), "{shown}");
        }
    }
}
