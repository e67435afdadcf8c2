//! Object stores as the commands see them: the environment of this process says how to get in.
//!
//! ```text
//! objects conform URL          run the conformance suite
//! objects probe URL            the start-up probe alone
//! objects list URL             the keys of all objects
//! objects fetch URL FOLDER     copy all objects into an empty folder
//! objects put URL KEY FILE     copy a file into the store
//! ```

use std::path::Path;
use std::process::ExitCode;

use sightline_store::BakeStore;
use sightline_tests::conformance;

type Error = Box<dyn std::error::Error + Send + Sync>;

#[tokio::main]
async fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    match run(&arguments).await {
        Ok(text) => {
            #[expect(clippy::print_stdout, reason = "a command")]
            {
                print!("{text}");
            }
            ExitCode::SUCCESS
        }
        Err(error) => {
            #[expect(clippy::print_stderr, reason = "a command")]
            {
                eprintln!("{error}");
            }
            ExitCode::FAILURE
        }
    }
}

async fn run(arguments: &[&str]) -> Result<String, Error> {
    match arguments {
        ["conform", url] => Ok(conformance::run(&BakeStore::open(url)?).await),
        ["probe", url] => {
            BakeStore::open(url)?.probe().await?;
            Ok("one writer wins\n".into())
        }
        ["fetch", url, folder] => {
            let store = BakeStore::open(url)?;
            let keys = store.list("").await?;
            for key in &keys {
                let path = Path::new(folder).join(key);
                std::fs::create_dir_all(path.parent().unwrap_or(Path::new(folder)))?;
                std::fs::write(path, store.get(key).await?)?;
            }
            Ok(format!("{} objects\n", keys.len()))
        }
        ["list", url] => Ok(BakeStore::open(url)?.list("").await?.join("\n") + "\n"),
        ["put", url, key, file] => {
            BakeStore::open(url)?.put_pointer(key, std::fs::read(file)?).await?;
            Ok(String::new())
        }
        _ => Err("objects conform|probe|list URL, fetch URL FOLDER, or put URL KEY FILE".into()),
    }
}
