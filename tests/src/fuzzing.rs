//! Random and mutated requests to a coordinator: a campaign by seed and time.
//!
//! What is sent, one kind a connection, chosen by chance:
//! - messages of every method with random values in every field, the likely ones often: numbers of
//!   workers, leases, tasks and epochs that there are;
//! - the same with bytes flipped, cut off, repeated or added, in the message, in gRPC's frame around
//!   it, or anywhere in HTTP/2;
//! - wrong paths, headers and credentials; messages over the limit that are announced or sent;
//! - frames of HTTP/2 that make no sense; bytes that are no HTTP/2 at all.
//!
//! Requests are written byte by byte (RFC 9113; HPACK without compression, RFC 7541), so that there
//! is no byte that a library would not let us get wrong.

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::time::{Duration, Instant};

use prost::Message;
use sightline_proto::v1;

/// Longest wait for a connection and for an answer.
const CONNECT_TIME: Duration = Duration::from_secs(5);
const ANSWER_TIME: Duration = Duration::from_millis(20);
/// Longest time that answers are read for: a stream of statuses has no end.
const LISTEN_TIME: Duration = Duration::from_millis(200);
/// What every HTTP/2 connection starts with.
const PREFACE: &[u8] = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";

/// Chance by a seed: SplitMix64 (Steele, Lea, Flood, 2014).
#[derive(Clone, Debug)]
pub struct Chance(pub u64);

impl Chance {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// Below `end`, which is not 0.
    fn below(&mut self, end: usize) -> usize {
        (self.next() % end as u64) as usize
    }

    fn once_in(&mut self, n: usize) -> bool {
        self.below(n) == 0
    }

    fn pick<T: Copy>(&mut self, from: &[T]) -> T {
        from[self.below(from.len())]
    }

    fn bytes(&mut self, count_max: usize) -> Vec<u8> {
        let count = self.below(count_max + 1);
        (0..count).map(|_| self.next() as u8).collect()
    }

    /// Small numbers, those at the ends, and any.
    fn number(&mut self) -> u64 {
        match self.below(8) {
            0..4 => self.below(40) as u64,
            4 => self.pick(&[0, u64::MAX, u64::MAX - 1, 1 << 31, u64::from(u32::MAX), 1 << 63]),
            5 => self.below(100_000) as u64,
            _ => self.next(),
        }
    }

    fn text(&mut self) -> String {
        match self.below(6) {
            0 => String::new(),
            1 => "x".repeat(self.below(20_000)),
            2 => "\u{0}\u{1b}[2J\u{202e}\n\r".repeat(1 + self.below(10)),
            3 => String::from_utf8_lossy(&self.bytes(200)).into_owned(),
            _ => format!("fuzz {}", self.below(1000)),
        }
    }
}

/// What the requests may know: credentials that are valid, and others.
#[derive(Clone, Debug)]
pub struct Target {
    /// The coordinator.
    pub address: SocketAddr,
    /// Tokens of a worker and of a viewer.
    pub tokens: [String; 2],
    /// The epoch of the coordinator.
    pub epoch: u64,
    /// The bake.
    pub bake_id: String,
}

/// What was sent.
#[derive(Clone, Copy, Debug, Default)]
pub struct Sent {
    /// Connections that were made.
    pub connections: u64,
    /// Requests, or pieces of them.
    pub requests: u64,
    /// Connections on which something was answered.
    pub answered: u64,
    /// Connections that could not be made: the coordinator closes them over its limits.
    pub refused: u64,
}

/// Attacks for a while.
pub fn attack(target: &Target, chance: &mut Chance, time: Duration) -> Sent {
    let (start, mut sent) = (Instant::now(), Sent::default());
    while start.elapsed() < time {
        let requests = 1 + chance.below(8);
        let bytes = connection(target, chance, requests);
        match send(target.address, &bytes, chance.once_in(8)) {
            Some(answered) => {
                sent.connections += 1;
                sent.requests += requests as u64;
                sent.answered += u64::from(answered);
            }
            None => sent.refused += 1,
        }
    }
    sent
}

/// Sends everything and looks at what comes; true when something does. `None` without a connection.
fn send(address: SocketAddr, bytes: &[u8], leave_at_once: bool) -> Option<bool> {
    let mut stream = TcpStream::connect_timeout(&address, CONNECT_TIME).ok()?;
    let _ = stream.set_write_timeout(Some(CONNECT_TIME));
    let _ = stream.set_read_timeout(Some(ANSWER_TIME));
    // The coordinator may have closed it already.
    let _ = stream.write_all(bytes);
    let mut buffer = [0; 16 << 10];
    let (start, mut answered) = (Instant::now(), false);
    let listen_time = if leave_at_once { Duration::ZERO } else { LISTEN_TIME };
    while start.elapsed() < listen_time {
        match stream.read(&mut buffer) {
            Ok(0) | Err(_) => break,
            Ok(_) => answered = true,
        }
    }
    Some(answered)
}

/// The bytes of one connection.
fn connection(target: &Target, chance: &mut Chance, requests: usize) -> Vec<u8> {
    if chance.once_in(20) {
        return chance.bytes(4096);
    }
    let mut bytes = PREFACE.to_vec();
    frame(&mut bytes, 4, 0, 0, &[]);
    for k in 0..requests {
        let stream = 1 + 2 * k as u32;
        if chance.once_in(6) {
            noise(&mut bytes, chance);
        }
        request(&mut bytes, target, chance, stream);
    }
    if chance.once_in(4) {
        let start = if chance.once_in(4) { 0 } else { PREFACE.len() };
        mutate(&mut bytes, start, chance);
    }
    bytes
}

/// Flips, cuts, repeats or adds bytes behind `start`.
fn mutate(bytes: &mut Vec<u8>, start: usize, chance: &mut Chance) {
    for _ in 0..=chance.below(6) {
        if bytes.len() <= start {
            return;
        }
        let at = start + chance.below(bytes.len() - start);
        match chance.below(5) {
            0 => bytes[at] ^= 1 << chance.below(8),
            1 => bytes[at] = chance.pick(&[0, 0x7f, 0x80, 0xff]),
            2 => bytes.truncate(at),
            3 => {
                let end = (at + chance.below(64)).min(bytes.len());
                let again = bytes[at..end].to_vec();
                bytes.splice(at..at, again);
            }
            _ => {
                let more = chance.bytes(16);
                bytes.splice(at..at, more);
            }
        }
    }
}

/// A frame of HTTP/2: RFC 9113, section 4.1.
fn frame(bytes: &mut Vec<u8>, kind: u8, flags: u8, stream: u32, payload: &[u8]) {
    bytes.extend_from_slice(&(payload.len() as u32).to_be_bytes()[1..]);
    bytes.extend_from_slice(&[kind, flags]);
    bytes.extend_from_slice(&stream.to_be_bytes());
    bytes.extend_from_slice(payload);
}

/// Frames that make no sense, or too many of those that do.
fn noise(bytes: &mut Vec<u8>, chance: &mut Chance) {
    let (kind, flags) =
        (chance.pick(&[0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 255]), chance.next() as u8);
    let stream = chance.pick(&[0, 1, 2, 3, 0x7fff_ffff, 0xffff_ffff]);
    let payload = match kind {
        6 => chance.bytes(8),
        3 | 8 => vec![0, 0, 0, chance.next() as u8],
        4 => (0..chance.below(20))
            .flat_map(|_| [0, chance.below(8) as u8, 0xff, 0xff, 0xff, 0xff])
            .collect(),
        _ => chance.bytes(64),
    };
    let times = if chance.once_in(10) { chance.below(2000) } else { 1 };
    for _ in 0..times {
        frame(bytes, kind, flags, stream, &payload);
    }
}

/// A header in HPACK: a literal that is not indexed, RFC 7541, section 6.2.2.
fn header(block: &mut Vec<u8>, name: &str, value: &[u8]) {
    block.push(0);
    for text in [name.as_bytes(), value] {
        // An integer with a prefix of 7 bits, section 5.1.
        let mut rest = text.len();
        if rest < 127 {
            block.push(rest as u8);
        } else {
            block.push(127);
            rest -= 127;
            while rest >= 128 {
                block.push((rest % 128) as u8 | 0x80);
                rest /= 128;
            }
            block.push(rest as u8);
        }
        block.extend_from_slice(text);
    }
}

/// A call: headers, and a message in a frame of gRPC.
fn request(bytes: &mut Vec<u8>, target: &Target, chance: &mut Chance, stream: u32) {
    let (path, message) = call(target, chance);
    let mut block = Vec::new();
    let path = match chance.below(12) {
        0 => format!("/{}", chance.text()),
        1 => path.replace("v1", "v2"),
        2 => format!("{path}/{path}"),
        _ => path.to_owned(),
    };
    let method: &[u8] = if chance.once_in(30) { b"GET" } else { b"POST" };
    header(&mut block, ":method", method);
    header(&mut block, ":scheme", b"http");
    header(&mut block, ":path", path.as_bytes());
    header(&mut block, ":authority", b"fuzz");
    let kind: &[u8] = if chance.once_in(20) { b"text/html" } else { b"application/grpc" };
    header(&mut block, "content-type", kind);
    header(&mut block, "te", b"trailers");
    authorize(&mut block, target, &path, chance);
    if chance.once_in(12) {
        let name = chance.pick(&[
            "grpc-timeout",
            "grpc-encoding",
            "traceparent",
            ":path",
            "Content-Length",
            "x",
            "connection",
        ]);
        let value = chance.bytes(300);
        header(&mut block, name, &value);
    }
    if chance.once_in(40) {
        header(&mut block, "x-large", &vec![b'x'; chance.below(40_000)]);
    }
    let ends = if chance.once_in(30) { 5 } else { 4 };
    let cut = block.len().min(16_000);
    frame(bytes, 1, if cut < block.len() { ends & !4 } else { ends }, stream, &block[..cut]);
    let rest: Vec<&[u8]> = block[cut..].chunks(16_000).collect();
    for (k, chunk) in rest.iter().enumerate() {
        frame(bytes, 9, if k + 1 == rest.len() { 4 } else { 0 }, stream, chunk);
    }
    let body = body(message, chance);
    let chunks: Vec<&[u8]> = body.chunks(16_000).collect();
    for (k, chunk) in chunks.iter().enumerate() {
        let is_end = k + 1 == chunks.len() && !chance.once_in(20);
        frame(bytes, 0, u8::from(is_end), stream, chunk);
    }
}

fn authorize(block: &mut Vec<u8>, target: &Target, path: &str, chance: &mut Chance) {
    let is_status = path.ends_with("Status");
    let right = &target.tokens[usize::from(is_status)];
    match chance.below(12) {
        0 => {}
        1 => header(block, "authorization", &chance.bytes(600)),
        2 => header(block, "authorization", format!("Bearer {}x", target.tokens[0]).as_bytes()),
        3 => {
            let other = &target.tokens[usize::from(!is_status)];
            header(block, "authorization", format!("Bearer {other}").as_bytes());
        }
        _ => header(block, "authorization", format!("Bearer {right}").as_bytes()),
    }
}

/// A message in the frame of gRPC: a flag and a length.
fn body(mut message: Vec<u8>, chance: &mut Chance) -> Vec<u8> {
    if chance.once_in(4) {
        mutate(&mut message, 0, chance);
    }
    if chance.once_in(400) {
        message.resize(sightline_proto::MESSAGE_BYTES_MAX + 1 + chance.below(1 << 20), 0x0a);
    }
    let flag = if chance.once_in(20) { chance.next() as u8 } else { 0 };
    let announced = match chance.below(16) {
        0 => chance.next() as u32,
        1 => u32::MAX,
        2 => (message.len() as u32).wrapping_sub(1),
        3 => message.len() as u32 + 1,
        _ => message.len() as u32,
    };
    let mut body = vec![flag];
    body.extend_from_slice(&announced.to_be_bytes());
    body.extend_from_slice(&message);
    body
}

/// A method and a message that suits it.
fn call(target: &Target, chance: &mut Chance) -> (&'static str, Vec<u8>) {
    let epoch = if chance.once_in(4) { chance.number() } else { target.epoch };
    let worker_id = chance.number() as u32;
    match chance.below(10) {
        0 => {
            let format_version = if chance.once_in(4) {
                chance.number() as u32
            } else {
                sightline_jobs::FORMAT_VERSION
            };
            let bake_id = if chance.once_in(2) { chance.text() } else { target.bake_id.clone() };
            let message = v1::RegisterRequest {
                worker_name: chance.text(),
                threads: chance.number() as u32,
                format_version,
                newest_epoch: if chance.once_in(3) { chance.number() } else { 0 },
                bake_id,
            };
            ("/sightline.v1.Coordinator/Register", message.encode_to_vec())
        }
        1 | 2 => {
            let message = v1::LeaseRequest { worker_id, epoch };
            ("/sightline.v1.Coordinator/Lease", message.encode_to_vec())
        }
        3 => {
            let count = if chance.once_in(20) { 5000 } else { chance.below(6) };
            let lease_ids = (0..count).map(|_| chance.number()).collect();
            let message = v1::HeartbeatRequest { worker_id, epoch, lease_ids };
            ("/sightline.v1.Coordinator/Heartbeat", message.encode_to_vec())
        }
        4 | 5 => ("/sightline.v1.Coordinator/Report", report(chance, worker_id, epoch)),
        6 => {
            let message = v1::GoodbyeRequest { worker_id, epoch };
            ("/sightline.v1.Coordinator/Goodbye", message.encode_to_vec())
        }
        7 => ("/sightline.v1.Coordinator/GetStatus", chance.bytes(20)),
        8 => ("/sightline.v1.Coordinator/WatchStatus", Vec::new()),
        _ => {
            let path = chance.pick(&[
                "/grpc.health.v1.Health/Check",
                "/grpc.health.v1.Health/Watch",
                "/grpc.reflection.v1.ServerReflection/ServerReflectionInfo",
            ]);
            let service = chance.text();
            let mut message = vec![0x0a, service.len().min(127) as u8];
            message.extend_from_slice(&service.as_bytes()[..service.len().min(127)]);
            (path, message)
        }
    }
}

/// Reports end attempts, so that only few of them fit a lease that there is.
fn report(chance: &mut Chance, worker_id: u32, epoch: u64) -> Vec<u8> {
    use v1::report_request::Result as Report;
    let result = match chance.below(4) {
        0 => None,
        1 => Some(Report::Committed(v1::Committed { solve_ms: chance.number() })),
        2 => Some(Report::Released(v1::Released {})),
        _ => {
            let class = chance.pick(&[0, 1, 2, 3, 4, -1, i32::MAX, i32::MIN]);
            Some(Report::Failed(v1::Failed { class, reason: chance.text() }))
        }
    };
    let message = v1::ReportRequest {
        worker_id,
        epoch,
        lease_id: chance.number(),
        task: chance.number() as u32,
        result,
    };
    message.encode_to_vec()
}
