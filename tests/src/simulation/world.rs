//! The hosts of a simulation and the course of a run.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use bytes::Bytes;
use hyper_util::rt::TokioIo;
use object_store::path::Path as Key;
use rand::rngs::SmallRng;
use rand::{Rng, SeedableRng};
use sightline_coordinator::clock::Clock;
use sightline_coordinator::{Coordinator, CoordinatorOptions, Prepared, prepare};
use sightline_jobs::{BakeConfig, SchedulePolicy};
use sightline_scene::generate::{Kind, generate};
use sightline_store::BakeStore;
use sightline_worker::{Worker, WorkerOptions};
use tokio::sync::watch;
use tonic::transport::{Channel, Endpoint};

use super::compute::{Results, SimCompute, Speed};
use super::faults::{Fault, Spell, draw};
use super::store::{SimStore, epochs};

/// Hosts that can coordinate, and hosts that work.
const COORDINATORS: usize = 2;
const WORKERS: usize = 3;
const HOSTS: usize = COORDINATORS + WORKERS;
/// Simulated time between two looks at the invariants, ms.
const STEP_MS: u64 = 20;
/// Longest time that a bake may take when the faults are over, ms. Leases run out, stalled writes arrive
/// and pauses end within it.
const CALM_MS_MAX: u64 = 600_000;
/// Simulated time between two faults, on average, ms.
const MEAN_GAP_MS: u64 = 1_200;
/// Time for which a simulation goes on behind the end of the bake, ms.
const LATE_MS: u64 = 20_000;
const PORT: u16 = 7070;

/// The bake that is simulated.
pub struct Bake {
    prepared: Prepared,
    results: Results,
    expected: Arc<BTreeMap<String, Bytes>>,
}

/// How a simulation ended.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Ended {
    /// Simulated time, ms.
    pub took_ms: u64,
    /// Faults that happened.
    pub faults: usize,
    /// Coordinators that there were.
    pub epochs: usize,
    /// Puts that arrived at the store.
    pub puts: u64,
    /// A hash of the history.
    pub history: String,
}

impl Bake {
    /// Prepares the bake of a small city in `folder`, and bakes it undisturbed.
    ///
    /// # Panics
    /// When that fails.
    #[must_use]
    pub fn prepare(folder: &Path) -> Self {
        let path = folder.join("simulated.glb");
        let mut file = std::fs::File::create(&path).expect("the scene can be written");
        let made = generate(Kind::City, 20_000, 7, &mut file).expect("a city can be generated");
        drop(file);
        let mut config = BakeConfig::default();
        let [x0, z0, ..] = made.suggested_region;
        config.region.rectangles = vec![[x0, z0, x0 + 20.0, z0 + 15.0]];
        config.region.cell_size = 5.0;
        config.solver.rows = 24;
        config.accuracy.rounds = 0;
        config.tasks.segments_per_task = 4;
        config.tasks.cells_per_task = 1;
        let prepared = prepare(&path, config).expect("the city can be baked");
        let bake = Self { prepared, results: Results::default(), expected: Arc::default() };
        let undisturbed = Simulation::new(&bake, 0).run(0);
        assert_eq!(undisturbed.1.faults, 0);
        let is_dataset = |key: &String| !key.starts_with("bake/");
        let dataset = undisturbed.0.into_iter().filter(|(key, _)| is_dataset(key)).collect();
        Self { expected: Arc::new(dataset), ..bake }
    }
}

/// Simulates a bake under the faults of a seed.
///
/// # Panics
/// With the first invariant that does not hold.
#[must_use]
pub fn run(bake: &Bake, seed: u64) -> Ended {
    let chaos_ms = SmallRng::seed_from_u64(seed).random_range(1_000..40_000);
    let (objects, ended) = Simulation::new(bake, seed).run(chaos_ms);
    for (key, expected) in &*bake.expected {
        assert_eq!(objects.get(key), Some(expected), "JB-2: {key} at the end");
    }
    ended
}

/// What the hosts and the course of the run share.
struct Controls {
    /// The host that is the coordinator.
    active: AtomicUsize,
    /// True when the dataset is published.
    is_over: AtomicBool,
    clocks: Vec<SkewedClock>,
    speeds: Vec<Arc<Mutex<Speed>>>,
    /// By worker, whether it is asked to stop.
    stops: Vec<watch::Sender<bool>>,
    auditors: Mutex<Vec<Auditor>>,
    /// Starts of coordinators so far: tells them apart.
    starts: AtomicU64,
}

type Auditor = Box<dyn Fn() + Send + Sync>;

/// A clock that runs as it likes, but not backwards.
#[derive(Clone)]
struct SkewedClock {
    /// Simulated time, ms.
    true_ms: Arc<AtomicU64>,
    skew: Arc<Mutex<Skew>>,
}

#[derive(Clone, Copy)]
struct Skew {
    /// When the rate was changed last, and what the clock showed then, ms.
    since_ms: u64,
    shown_ms: u64,
    percent: u64,
}

impl SkewedClock {
    fn new(true_ms: &Arc<AtomicU64>) -> Self {
        let skew = Skew { since_ms: 0, shown_ms: 0, percent: 100 };
        Self { true_ms: Arc::clone(true_ms), skew: Arc::new(Mutex::new(skew)) }
    }

    fn change(&self, jump_ms: u64, percent: u64) {
        let shown_ms = self.now_ms() + jump_ms;
        let since_ms = self.true_ms.load(Ordering::Relaxed);
        *lock(&self.skew) = Skew { since_ms, shown_ms, percent };
    }
}

impl Clock for SkewedClock {
    fn now_ms(&self) -> u64 {
        let Skew { since_ms, shown_ms, percent } = *lock(&self.skew);
        shown_ms + (self.true_ms.load(Ordering::Relaxed) - since_ms) * percent / 100
    }
}

/// One run: the hosts, what goes wrong now, and what is left behind.
struct Simulation<'a> {
    bake: &'a Bake,
    seed: u64,
    rng: SmallRng,
    now_ms: Arc<AtomicU64>,
    store: SimStore,
    controls: Arc<Controls>,
    /// Faults at work, and when they end.
    spells: Vec<(u64, Fault)>,
    faults: usize,
    crashed: [bool; HOSTS],
}

impl<'a> Simulation<'a> {
    fn new(bake: &'a Bake, seed: u64) -> Self {
        let now_ms = Arc::new(AtomicU64::new(0));
        let controls = Controls {
            active: AtomicUsize::new(0),
            is_over: AtomicBool::new(false),
            clocks: (0..COORDINATORS).map(|_| SkewedClock::new(&now_ms)).collect(),
            speeds: (0..WORKERS).map(|_| Arc::default()).collect(),
            stops: (0..WORKERS).map(|_| watch::channel(false).0).collect(),
            auditors: Mutex::default(),
            starts: AtomicU64::new(0),
        };
        Self {
            bake,
            seed,
            rng: SmallRng::seed_from_u64(seed),
            now_ms,
            store: SimStore::new(seed, HOSTS, Arc::clone(&bake.expected)),
            controls: Arc::new(controls),
            spells: Vec::new(),
            faults: 0,
            crashed: [false; HOSTS],
        }
    }

    /// Runs to the end, with faults in the first `chaos_ms`.
    fn run(mut self, chaos_ms: u64) -> (BTreeMap<String, Bytes>, Ended) {
        let mut sim = turmoil::Builder::new()
            .rng_seed(self.seed)
            .enable_random_order()
            .tick_duration(Duration::from_millis(STEP_MS))
            .min_message_latency(Duration::from_millis(1))
            .max_message_latency(Duration::from_millis(40))
            .simulation_duration(Duration::from_secs(1 << 30))
            .tcp_capacity(4096)
            .build();
        for host in 0..HOSTS {
            self.add_host(&mut sim, host);
        }
        let mut quiet_since_ms = None;
        loop {
            sim.step().unwrap_or_else(|error| panic!("seed {}: {error}", self.seed));
            let now_ms = self.now_ms.fetch_add(STEP_MS, Ordering::Relaxed) + STEP_MS;
            self.store.advance(now_ms);
            lock(&self.controls.auditors).iter().for_each(|audit| audit());
            self.end_spells(&mut sim, now_ms.max(if now_ms < chaos_ms { 0 } else { u64::MAX }));
            if now_ms < chaos_ms && self.rng.random_range(0..MEAN_GAP_MS) < STEP_MS {
                let spell = draw(&mut self.rng, COORDINATORS, HOSTS);
                self.start_spell(&mut sim, spell, now_ms);
            }
            if self.controls.is_over.load(Ordering::Relaxed) {
                let since_ms = *quiet_since_ms.get_or_insert(now_ms);
                // Writers that stalled wake up, and change nothing.
                if now_ms > since_ms.max(chaos_ms) + LATE_MS {
                    break;
                }
            }
            assert!(
                now_ms < chaos_ms + CALM_MS_MAX,
                "the bake does not end although nothing goes wrong any more"
            );
        }
        let objects = self.store.objects();
        let ended = Ended {
            took_ms: quiet_since_ms.unwrap_or(0),
            faults: self.faults,
            epochs: epochs(&objects).len(),
            puts: self.store.puts(),
            history: self.store.history(),
        };
        (objects, ended)
    }

    fn add_host(&self, sim: &mut turmoil::Sim<'_>, host: usize) {
        let controls = Arc::clone(&self.controls);
        let store = BakeStore::new(Arc::new(self.store.of_host(host)), Key::default(), "simulated");
        let Prepared { plan, publisher, scene, .. } = &self.bake.prepared;
        if host < COORDINATORS {
            let (plan, publisher) = (plan.clone(), publisher.clone());
            sim.host(name(host), move || {
                let mut options = CoordinatorOptions::new(
                    SocketAddr::from(([127, 0, 0, 1], PORT)),
                    store.clone(),
                    plan.clone(),
                    Arc::new(publisher.clone()),
                );
                options.policy = POLICY;
                options.linger = Duration::from_secs(1);
                options.clock = Arc::new(controls.clocks[host].clone());
                coordinate(host, Arc::clone(&controls), options)
            });
            return;
        }
        let worker = host - COORDINATORS;
        let mut options = WorkerOptions::new(&format!("http://coordinator:{PORT}"));
        options.store = Some(store);
        options.scene = Some(Arc::clone(scene));
        options.threads = 1;
        options.name = name(host);
        options.patience = Duration::from_secs(8);
        options.drain = Duration::from_millis(500 * worker as u64);
        options.compute = Some(Arc::new(SimCompute::new(
            self.seed ^ host as u64,
            Arc::clone(&controls.speeds[worker]),
            Arc::clone(&self.bake.results),
        )));
        options.dial = Some(dial(&controls));
        sim.host(name(host), move || work(worker, Arc::clone(&controls), options.clone()));
    }

    fn start_spell(&mut self, sim: &mut turmoil::Sim<'_>, spell: Spell, now_ms: u64) {
        let Spell { fault, lasts_ms } = spell;
        self.faults += 1;
        self.store.note(&format!("{now_ms} {fault:?} for {lasts_ms} ms\n"));
        tracing::info!(now_ms, lasts_ms, ?fault, "a fault");
        let controls = Arc::clone(&self.controls);
        match fault {
            Fault::Crash { host } => {
                if !std::mem::replace(&mut self.crashed[host], true) {
                    sim.crash(name(host));
                }
            }
            Fault::Stop { worker } => _ = controls.stops[worker - COORDINATORS].send_replace(true),
            Fault::Partition { a, b } => sim.partition(name(a), name(b)),
            Fault::PartitionOneWay { from, to } => sim.partition_oneway(name(from), name(to)),
            Fault::Hold { a, b } => sim.hold(name(a), name(b)),
            Fault::Switch => _ = controls.active.fetch_xor(1, Ordering::Relaxed),
            Fault::StoreDown { host } => self.store.set_way(host, |way| way.is_down = true),
            Fault::StoreLossy { host, percent } => {
                self.store.set_way(host, |way| way.loss_percent = percent);
            }
            Fault::StoreStalls { host, up_to_ms } => {
                self.store.set_way(host, |way| way.stall_ms = up_to_ms);
            }
            Fault::ClockJump { host, by_ms } => controls.clocks[host].change(by_ms, 100),
            Fault::ClockRate { host, percent } => controls.clocks[host].change(0, percent),
            Fault::Slow { worker, factor } => {
                lock(&controls.speeds[worker - COORDINATORS]).factor = factor;
            }
            Fault::Failing { worker, percent } => {
                lock(&controls.speeds[worker - COORDINATORS]).failing_percent = percent;
            }
        }
        self.spells.push((now_ms + lasts_ms, fault));
    }

    /// Ends the faults whose time is up.
    fn end_spells(&mut self, sim: &mut turmoil::Sim<'_>, now_ms: u64) {
        let (over, rest) = self.spells.drain(..).partition(|(until_ms, _)| *until_ms <= now_ms);
        self.spells = rest;
        let over: Vec<(u64, Fault)> = over;
        for (_, fault) in over {
            self.end_fault(sim, fault);
        }
    }

    fn end_fault(&mut self, sim: &mut turmoil::Sim<'_>, fault: Fault) {
        let controls = &self.controls;
        match fault {
            Fault::Crash { host } => {
                if std::mem::take(&mut self.crashed[host]) {
                    sim.bounce(name(host));
                }
            }
            Fault::Stop { worker } => _ = controls.stops[worker - COORDINATORS].send_replace(false),
            Fault::Partition { a, b } => sim.repair(name(a), name(b)),
            Fault::PartitionOneWay { from, to } => sim.repair_oneway(name(from), name(to)),
            Fault::Hold { a, b } => sim.release(name(a), name(b)),
            Fault::Switch | Fault::ClockJump { .. } => {}
            Fault::StoreDown { host } => self.store.set_way(host, |way| way.is_down = false),
            Fault::StoreLossy { host, .. } => self.store.set_way(host, |way| way.loss_percent = 0),
            Fault::StoreStalls { host, .. } => self.store.set_way(host, |way| way.stall_ms = 0),
            Fault::ClockRate { host, .. } => controls.clocks[host].change(0, 100),
            Fault::Slow { worker, .. } => lock(&controls.speeds[worker - COORDINATORS]).factor = 1,
            Fault::Failing { worker, .. } => {
                lock(&controls.speeds[worker - COORDINATORS]).failing_percent = 0;
            }
        }
    }
}

/// Limits that fit the simulation: a task takes half a second.
const POLICY: SchedulePolicy = SchedulePolicy {
    lease_ms: 3_000,
    failures_max: 3,
    pause_ms: 500,
    pause_ms_max: 5_000,
    retries_later_max: 10,
    losses_max: 6,
    worker_failures_max: 2,
    straggler_percent: 150,
    straggler_ms_min: 200,
    straggler_ms_unknown: 10_000,
    workers_max: 20,
};

/// Starts coordinators until the dataset is published, while this host is the one to do so.
async fn coordinate(
    host: usize,
    controls: Arc<Controls>,
    options: CoordinatorOptions,
) -> turmoil::Result {
    let mut options = Some(options);
    while !controls.is_over.load(Ordering::Relaxed) {
        tokio::time::sleep(Duration::from_millis(300)).await;
        if controls.active.load(Ordering::Relaxed) != host {
            continue;
        }
        let listener = turmoil::net::TcpListener::bind(("0.0.0.0", PORT)).await?;
        let incoming = futures::stream::unfold(listener, |listener| async move {
            let accepted = listener.accept().await;
            Some((accepted, listener))
        });
        let start = controls.starts.fetch_add(1, Ordering::Relaxed);
        let own = options.take().expect("put back behind each start");
        options = Some(copy_of(&own));
        let own = CoordinatorOptions { name: format!("start {start}"), ..own };
        let addr = own.listen;
        let ended = async {
            let handle = Coordinator::start_on(own, incoming, addr).await?;
            lock(&controls.auditors).push(Box::new(handle.auditor()));
            handle.join().await
        };
        match ended.await {
            Ok(_) => controls.is_over.store(true, Ordering::Relaxed),
            Err(error) => tracing::info!(host, %error, "a coordinator ended"),
        }
    }
    Ok(())
}

fn copy_of(options: &CoordinatorOptions) -> CoordinatorOptions {
    let (store, plan) = (options.store.clone(), options.plan.clone());
    let mut copy =
        CoordinatorOptions::new(options.listen, store, plan, Arc::clone(&options.publisher));
    copy.policy = options.policy;
    copy.linger = options.linger;
    copy.clock = Arc::clone(&options.clock);
    copy
}

/// Starts workers until the dataset is published.
async fn work(worker: usize, controls: Arc<Controls>, options: WorkerOptions) -> turmoil::Result {
    while !controls.is_over.load(Ordering::Relaxed) {
        let mut asked = controls.stops[worker].subscribe();
        let stop = async {
            // The sender lives as long as the simulation.
            let _ = asked.wait_for(|asked| *asked).await;
        };
        if let Err(error) = Worker::run(options.clone(), stop).await {
            tracing::info!(worker, %error, "a worker ended");
        }
        tokio::time::sleep(Duration::from_millis(300)).await;
    }
    Ok(())
}

/// Connects to the host that is the coordinator at that time.
fn dial(controls: &Arc<Controls>) -> sightline_worker::Dial {
    let controls = Arc::clone(controls);
    Arc::new(move |endpoint: &Endpoint| -> Channel {
        let controls = Arc::clone(&controls);
        endpoint.connect_with_connector_lazy(tower::service_fn(move |_: http::Uri| {
            let host = name(controls.active.load(Ordering::Relaxed));
            async move {
                let stream = turmoil::net::TcpStream::connect((host, PORT)).await?;
                Ok::<_, std::io::Error>(TokioIo::new(stream))
            }
        }))
    })
}

fn name(host: usize) -> String {
    if host < COORDINATORS {
        format!("coordinator-{host}")
    } else {
        format!("worker-{}", host - COORDINATORS)
    }
}

fn lock<T>(mutex: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
