//! A fuzz campaign against a coordinator, by time and seed:
//!
//! ```sh
//! cargo run --release -p sightline-tests --example fuzz_grpc -- [SECONDS] [SEED] [ATTACKERS]
//! ```
//!
//! What is sent and what has to hold is in `tests/src/fuzzing.rs` and `tests/src/campaign.rs`. It
//! prints the figures, or panics with what does not hold; the coordinator's log is then shown.

use std::io::Write;
use std::time::Duration;

use sightline_tests::campaign::Campaign;
use sightline_tests::city::City;

fn main() {
    let number = |at: usize, absent: u64| {
        let given = std::env::args().nth(at);
        given.map_or(absent, |text| text.parse().expect("SECONDS, SEED and ATTACKERS are numbers"))
    };
    let (seconds, seed, attackers) = (number(1, 3600), number(2, 1), number(3, 4));
    let folder = tempfile::tempdir().expect("a temporary folder can be made");
    let city = City::bake(&folder.path().join("city"));
    let campaign = Campaign {
        folder: folder.path().to_owned(),
        scene: city.scene,
        baked: city.dataset,
        seed,
        time: Duration::from_secs(seconds),
        attackers,
    };
    let figures = campaign.run();
    let text = format!("{seconds} s, seed {seed}, {attackers} attackers: {figures:#?}\n");
    std::io::stdout().write_all(text.as_bytes()).expect("stdout takes the figures");
}
