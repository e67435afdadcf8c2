//! What the Job controller of Kubernetes does about pods that end: which to start, and when the
//! Job is over. A state machine without processes and clocks; [`crate::pods`] runs it.
//!
//! Source: <https://kubernetes.io/docs/concepts/workloads/controllers/job/>. The tests below are
//! the examples of that page and of the tasks that it links to.
//!
//! Known and kept: indexed and plain completion, `podFailurePolicy` (rules in order, the first
//! that matches decides), `backoffLimit`, `backoffLimitPerIndex`, `maxFailedIndexes`,
//! `successPolicy`, `podReplacementPolicy`. Where a failure and a success are due at the same
//! time, the failure wins. Left out: `activeDeadlineSeconds`, suspension, and the growing pause
//! before a pod is replaced (tests need not wait for it). Only `restartPolicy: Never` is known:
//! with `OnFailure` no failure policy may be given.

use std::collections::{BTreeMap, BTreeSet};

use k8s_openapi::api::batch::v1::{
    JobSpec, PodFailurePolicyOnExitCodesRequirement, PodFailurePolicyOnPodConditionsPattern,
    PodFailurePolicyRule, SuccessPolicyRule,
};

/// A pod that was started.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct PodId(pub u32);

/// How a pod ended.
#[derive(Clone, Debug, Default)]
pub struct PodEnd {
    /// Exit code of each container.
    pub exit_codes: BTreeMap<String, i32>,
    /// Conditions of the pod that hold, such as `DisruptionTarget`.
    pub conditions: BTreeSet<String>,
}

impl PodEnd {
    /// True when every container ended with 0.
    #[must_use]
    pub fn is_success(&self) -> bool {
        self.exit_codes.values().all(|code| *code == 0)
    }
}

/// Where a Job stands. The reasons are those of the Job's conditions.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// Pods run or will.
    Running,
    /// The Job has the condition `Complete`.
    Complete(&'static str),
    /// The Job has the condition `Failed`.
    Failed(&'static str),
}

/// A pod that has not ended.
#[derive(Clone, Copy, Debug)]
struct Active {
    index: Option<u32>,
    is_terminating: bool,
}

/// A running Job.
#[derive(Clone, Debug)]
pub struct JobState {
    spec: JobSpec,
    active: BTreeMap<PodId, Active>,
    pods_started: u32,
    /// Successful pods of a plain Job.
    successes: u32,
    succeeded_indexes: BTreeSet<u32>,
    failed_indexes: BTreeSet<u32>,
    failures_of: BTreeMap<Option<u32>, u32>,
    failures: u32,
    ignored: u32,
    verdict: Verdict,
}

impl JobState {
    /// A Job that was just created.
    ///
    /// # Panics
    /// When the API server would refuse the Job, or it needs what this module leaves out.
    #[must_use]
    pub fn new(spec: &JobSpec) -> Self {
        let template = spec.template.spec.as_ref().expect("a Job has a pod template");
        let never = template.restart_policy.as_deref() == Some("Never");
        assert!(never, "only restartPolicy Never is known");
        let is_indexed = spec.completion_mode.as_deref() == Some("Indexed");
        assert!(is_indexed || spec.success_policy.is_none(), "successPolicy is for indexed Jobs");
        let per_index = spec.backoff_limit_per_index.is_some();
        assert!(is_indexed || !per_index, "backoffLimitPerIndex is for indexed Jobs");
        assert!(per_index || spec.max_failed_indexes.is_none(), "nothing can fail an index");
        let rules = spec.pod_failure_policy.as_ref().map_or(&[][..], |policy| &policy.rules);
        let fail_index = rules.iter().any(|rule| rule.action == "FailIndex");
        assert!(per_index || !fail_index, "FailIndex needs backoffLimitPerIndex");
        let replaced_early = spec.pod_replacement_policy.as_deref() == Some("TerminatingOrFailed");
        assert!(rules.is_empty() || !replaced_early, "a failure policy waits for the pod's end");
        Self {
            spec: spec.clone(),
            active: BTreeMap::new(),
            pods_started: 0,
            successes: 0,
            succeeded_indexes: BTreeSet::new(),
            failed_indexes: BTreeSet::new(),
            failures_of: BTreeMap::new(),
            failures: 0,
            ignored: 0,
            verdict: Verdict::Running,
        }
    }

    /// Where the Job stands.
    #[must_use]
    pub const fn verdict(&self) -> Verdict {
        self.verdict
    }

    /// Indexes with a pod that succeeded.
    #[must_use]
    pub const fn succeeded_indexes(&self) -> &BTreeSet<u32> {
        &self.succeeded_indexes
    }

    /// Indexes that were given up.
    #[must_use]
    pub const fn failed_indexes(&self) -> &BTreeSet<u32> {
        &self.failed_indexes
    }

    /// Pods that failed and count.
    #[must_use]
    pub const fn failures(&self) -> u32 {
        self.failures
    }

    /// Pods that failed and were ignored by policy.
    #[must_use]
    pub const fn ignored(&self) -> u32 {
        self.ignored
    }

    /// The next pod to start, by its index (`None` inside for a plain Job).
    #[must_use]
    pub fn next_pod(&self) -> Option<Option<u32>> {
        let holds = |pod: &Active| !pod.is_terminating || !self.replaces_terminating();
        let held: Vec<Option<u32>> =
            self.active.values().filter(|p| holds(p)).map(|p| p.index).collect();
        let room = held.len() < positive(self.spec.parallelism.unwrap_or(1));
        if self.verdict != Verdict::Running || !room {
            return None;
        }
        if self.is_indexed() {
            let is_open = |index: &u32| {
                !self.succeeded_indexes.contains(index)
                    && !self.failed_indexes.contains(index)
                    && !held.contains(&Some(*index))
            };
            return (0..self.completions()).find(is_open).map(Some);
        }
        let wanted = self.completions().saturating_sub(self.successes) as usize;
        (held.len() < wanted).then_some(None)
    }

    /// A pod was started.
    pub fn started(&mut self, index: Option<u32>) -> PodId {
        let id = PodId(self.pods_started);
        self.pods_started += 1;
        self.active.insert(id, Active { index, is_terminating: false });
        id
    }

    /// A pod was asked to end: it was deleted, evicted or preempted.
    pub fn terminating(&mut self, pod: PodId) {
        if let Some(active) = self.active.get_mut(&pod) {
            active.is_terminating = true;
        }
    }

    /// A pod ended.
    ///
    /// # Panics
    /// When it did not run.
    pub fn ended(&mut self, pod: PodId, end: &PodEnd) {
        let active = self.active.remove(&pod).expect("a pod that ends has been started");
        if self.verdict != Verdict::Running {
            return;
        }
        if end.is_success() {
            match active.index {
                Some(index) => _ = self.succeeded_indexes.insert(index),
                None => self.successes += 1,
            }
        } else {
            self.failed(active.index, end);
        }
        if self.verdict == Verdict::Running {
            self.verdict = self.judge();
        }
    }

    fn failed(&mut self, index: Option<u32>, end: &PodEnd) {
        match self.action(end) {
            "FailJob" => self.verdict = Verdict::Failed("PodFailurePolicy"),
            "Ignore" => self.ignored += 1,
            "FailIndex" => self.failed_indexes.extend(index),
            "Count" => {
                self.failures += 1;
                let of_index = self.failures_of.entry(index).or_default();
                *of_index += 1;
                let limit = self.spec.backoff_limit_per_index;
                if limit.is_some_and(|limit| i64::from(*of_index) > i64::from(limit)) {
                    self.failed_indexes.extend(index);
                }
            }
            other => panic!("`{other}` is no action of a failure policy"),
        }
    }

    /// The action of the first rule that matches; failures count where none does.
    fn action(&self, end: &PodEnd) -> &str {
        let policy = self.spec.pod_failure_policy.as_ref();
        let rules = policy.map_or(&[][..], |policy| &policy.rules);
        rules.iter().find(|rule| matches(rule, end)).map_or("Count", |rule| rule.action.as_str())
    }

    fn judge(&self) -> Verdict {
        let default = if self.spec.backoff_limit_per_index.is_some() { i32::MAX } else { 6 };
        let limit = self.spec.backoff_limit.unwrap_or(default);
        if i64::from(self.failures) > i64::from(limit) {
            return Verdict::Failed("BackoffLimitExceeded");
        }
        let lost = self.failed_indexes.len();
        if self.spec.max_failed_indexes.is_some_and(|max| lost > positive(max)) {
            return Verdict::Failed("MaxFailedIndexesExceeded");
        }
        let done = self.succeeded_indexes.len();
        let is_finished = self.is_indexed() && lost + done >= self.completions() as usize;
        if is_finished && lost > 0 {
            return Verdict::Failed("FailedIndexes");
        }
        if self.meets_success_policy() {
            return Verdict::Complete("SuccessPolicy");
        }
        let all =
            if self.is_indexed() { is_finished } else { self.successes >= self.completions() };
        if all { Verdict::Complete("CompletionsReached") } else { Verdict::Running }
    }

    fn meets_success_policy(&self) -> bool {
        let policy = self.spec.success_policy.as_ref();
        let rules = policy.map_or(&[][..], |policy| &policy.rules);
        rules.iter().any(|rule| self.meets(rule))
    }

    fn meets(&self, rule: &SuccessPolicyRule) -> bool {
        let listed = rule.succeeded_indexes.as_deref().map(parse_indexes);
        let counts = |index: &&u32| listed.as_ref().is_none_or(|listed| listed.contains(*index));
        let done = self.succeeded_indexes.iter().filter(counts).count();
        match (rule.succeeded_count, &listed) {
            (Some(count), _) => done >= positive(count),
            (None, Some(listed)) => done == listed.len(),
            (None, None) => panic!("a rule of a successPolicy names indexes or a number"),
        }
    }

    fn is_indexed(&self) -> bool {
        self.spec.completion_mode.as_deref() == Some("Indexed")
    }

    fn completions(&self) -> u32 {
        u32::try_from(self.spec.completions.unwrap_or(1)).unwrap_or(0)
    }

    fn replaces_terminating(&self) -> bool {
        match self.spec.pod_replacement_policy.as_deref() {
            Some(policy) => policy == "TerminatingOrFailed",
            None => self.spec.pod_failure_policy.is_none(),
        }
    }
}

fn matches(rule: &PodFailurePolicyRule, end: &PodEnd) -> bool {
    let codes = rule.on_exit_codes.as_ref();
    let conditions = rule.on_pod_conditions.as_deref();
    codes.is_some_and(|codes| matches_codes(codes, end))
        || conditions.is_some_and(|patterns| patterns.iter().any(|p| matches_condition(p, end)))
}

/// Containers that ended with 0 never match.
fn matches_codes(rule: &PodFailurePolicyOnExitCodesRequirement, end: &PodEnd) -> bool {
    let is_meant = |name: &str| rule.container_name.as_deref().is_none_or(|meant| meant == name);
    let failed = end.exit_codes.iter().filter(|(name, code)| **code != 0 && is_meant(name));
    failed.map(|(_, code)| rule.values.contains(code)).any(|listed| match rule.operator.as_str() {
        "In" => listed,
        "NotIn" => !listed,
        other => panic!("`{other}` is no operator for exit codes"),
    })
}

fn matches_condition(pattern: &PodFailurePolicyOnPodConditionsPattern, end: &PodEnd) -> bool {
    end.conditions.contains(&pattern.type_) == (pattern.status == "True")
}

/// `0,2-3` as numbers.
fn parse_indexes(text: &str) -> BTreeSet<u32> {
    let number = |text: &str| text.parse::<u32>().expect("an index is a number");
    text.split(',')
        .flat_map(|part| {
            let (from, to) = part.split_once('-').unwrap_or((part, part));
            number(from)..=number(to)
        })
        .collect()
}

fn positive(value: i32) -> usize {
    usize::try_from(value).unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;

    /// A Job with these fields and a pod template.
    fn job(fields: Value) -> JobState {
        let mut spec = json!({ "template": { "spec": {
            "restartPolicy": "Never", "containers": [{ "name": "main" }]
        }}});
        spec.as_object_mut().unwrap().extend(fields.as_object().unwrap().clone());
        JobState::new(&serde_json::from_value(spec).unwrap())
    }

    fn exit(code: i32) -> PodEnd {
        PodEnd { exit_codes: BTreeMap::from([("main".into(), code)]), ..PodEnd::default() }
    }

    fn disrupted(code: i32) -> PodEnd {
        PodEnd { conditions: BTreeSet::from(["DisruptionTarget".into()]), ..exit(code) }
    }

    /// Starts pods while there is room.
    fn start(job: &mut JobState) -> Vec<(PodId, Option<u32>)> {
        let mut started = Vec::new();
        while let Some(index) = job.next_pod() {
            started.push((job.started(index), index));
        }
        started
    }

    /// Runs pods to the end of the Job; `outcome` says how the pod of an index ends.
    fn run(job: &mut JobState, outcome: impl Fn(Option<u32>) -> PodEnd) {
        let mut running = start(job);
        while let Some((pod, index)) = running.pop() {
            job.ended(pod, &outcome(index));
            running.extend(start(job));
        }
    }

    /// "Handling Pod and container failures": the default is six retries.
    #[test]
    fn failures_up_to_the_backoff_limit_are_retried() {
        let mut job = job(json!({ "completions": 1 }));
        for _ in 0..6 {
            let [(pod, None)] = start(&mut job)[..] else { panic!("one pod at a time") };
            job.ended(pod, &exit(1));
            assert_eq!(job.verdict(), Verdict::Running);
        }
        run(&mut job, |_| exit(1));
        assert_eq!(job.verdict(), Verdict::Failed("BackoffLimitExceeded"));
        assert_eq!(job.failures(), 7);
    }

    /// The example of "Pod failure policy": 42 of the container main fails the Job, a disruption
    /// is ignored, the rest counts.
    fn example_policy() -> Value {
        json!({ "completions": 12, "parallelism": 3, "backoffLimit": 6, "podFailurePolicy": {
            "rules": [
                { "action": "FailJob",
                  "onExitCodes": { "containerName": "main", "operator": "In", "values": [42] } },
                { "action": "Ignore",
                  "onPodConditions": [{ "type": "DisruptionTarget", "status": "True" }] }
            ]
        }})
    }

    #[test]
    fn an_exit_code_of_the_policy_fails_the_job_at_once() {
        let mut job = job(example_policy());
        let pods = start(&mut job);
        assert_eq!(pods.len(), 3, "parallelism");
        job.ended(pods[0].0, &exit(42));
        assert_eq!(job.verdict(), Verdict::Failed("PodFailurePolicy"));
        assert_eq!(job.next_pod(), None);
        // Pods that are still there end as they like.
        job.ended(pods[1].0, &exit(0));
        assert_eq!(job.verdict(), Verdict::Failed("PodFailurePolicy"));
    }

    #[test]
    fn disruptions_are_not_counted() {
        let mut job = job(example_policy());
        for _ in 0..100 {
            for (pod, _) in start(&mut job) {
                job.ended(pod, &disrupted(137));
            }
        }
        assert_eq!((job.failures(), job.ignored()), (0, 300));
        run(&mut job, |_| exit(0));
        assert_eq!(job.verdict(), Verdict::Complete("CompletionsReached"));
    }

    #[test]
    fn the_first_rule_that_matches_decides() {
        let mut job = job(example_policy());
        let pods = start(&mut job);
        job.ended(pods[0].0, &disrupted(42));
        assert_eq!(job.verdict(), Verdict::Failed("PodFailurePolicy"));
    }

    #[test]
    fn a_rule_for_another_container_does_not_match() {
        let mut job = job(json!({ "completions": 1, "podFailurePolicy": { "rules": [
            { "action": "FailJob",
              "onExitCodes": { "containerName": "sidecar", "operator": "In", "values": [42] } }
        ]}}));
        let pods = start(&mut job);
        job.ended(pods[0].0, &exit(42));
        assert_eq!((job.verdict(), job.failures()), (Verdict::Running, 1));
    }

    #[test]
    fn codes_that_are_not_in_a_list_match_not_in() {
        let policy = json!({ "completions": 1, "podFailurePolicy": { "rules": [
            { "action": "FailJob", "onExitCodes": { "operator": "NotIn", "values": [40, 41] } }
        ]}});
        for (code, verdict) in [(40, Verdict::Running), (1, Verdict::Failed("PodFailurePolicy"))] {
            let mut job = job(policy.clone());
            let pods = start(&mut job);
            job.ended(pods[0].0, &exit(code));
            assert_eq!(job.verdict(), verdict, "{code}");
        }
    }

    /// The example of "Backoff limit per index": even indexes always fail.
    #[test]
    fn an_index_that_fails_does_not_stop_the_others() {
        let mut job = job(json!({
            "completions": 10, "parallelism": 3, "completionMode": "Indexed",
            "backoffLimitPerIndex": 1, "maxFailedIndexes": 5
        }));
        run(&mut job, |index| exit(i32::from(index.unwrap().is_multiple_of(2))));
        assert_eq!(job.verdict(), Verdict::Failed("FailedIndexes"));
        assert_eq!(*job.failed_indexes(), BTreeSet::from([0, 2, 4, 6, 8]));
        assert_eq!(*job.succeeded_indexes(), BTreeSet::from([1, 3, 5, 7, 9]));
        assert_eq!(job.failures(), 10, "each failed twice");
    }

    #[test]
    fn too_many_failed_indexes_fail_the_job() {
        let mut job = job(json!({
            "completions": 10, "parallelism": 1, "completionMode": "Indexed",
            "backoffLimitPerIndex": 0, "maxFailedIndexes": 2
        }));
        run(&mut job, |_| exit(1));
        assert_eq!(job.verdict(), Verdict::Failed("MaxFailedIndexesExceeded"));
        assert_eq!(job.failed_indexes().len(), 3);
    }

    /// The example of "Using Pod failure policy to avoid unnecessary Pod retries per index".
    #[test]
    fn fail_index_gives_an_index_up_without_retries() {
        let mut job = job(json!({
            "completions": 4, "parallelism": 2, "completionMode": "Indexed",
            "backoffLimitPerIndex": 1, "podFailurePolicy": { "rules": [
                { "action": "FailIndex", "onExitCodes": { "operator": "In", "values": [42] } }
            ]}
        }));
        run(&mut job, |index| exit(if index == Some(1) { 42 } else { 0 }));
        assert_eq!(job.verdict(), Verdict::Failed("FailedIndexes"));
        assert_eq!(*job.failed_indexes(), BTreeSet::from([1]));
        assert_eq!((job.succeeded_indexes().len(), job.failures()), (3, 0));
    }

    /// The example of "Success policy": one of 0, 2 and 3 suffices.
    #[test]
    fn a_success_policy_ends_the_job_early() {
        let policy = json!({
            "completions": 10, "parallelism": 10, "completionMode": "Indexed",
            "successPolicy": { "rules": [{ "succeededIndexes": "0,2-3", "succeededCount": 1 }] }
        });
        let mut job = job(policy);
        let pods = start(&mut job);
        job.ended(pods[1].0, &exit(0));
        assert_eq!(job.verdict(), Verdict::Running, "1 is not on the list");
        job.ended(pods[3].0, &exit(0));
        assert_eq!(job.verdict(), Verdict::Complete("SuccessPolicy"));
        assert_eq!(job.next_pod(), None);
    }

    #[test]
    fn without_a_count_all_listed_indexes_must_succeed() {
        let mut job = job(json!({
            "completions": 3, "parallelism": 3, "completionMode": "Indexed",
            "successPolicy": { "rules": [{ "succeededIndexes": "0-1" }] }
        }));
        let pods = start(&mut job);
        job.ended(pods[0].0, &exit(0));
        assert_eq!(job.verdict(), Verdict::Running);
        job.ended(pods[1].0, &exit(0));
        assert_eq!(job.verdict(), Verdict::Complete("SuccessPolicy"));
    }

    /// "Pod replacement policy".
    #[test]
    fn a_terminating_pod_is_replaced_when_the_policy_says() {
        for (policy, early) in [("Failed", false), ("TerminatingOrFailed", true)] {
            let mut job = job(json!({
                "completions": 1, "completionMode": "Indexed", "podReplacementPolicy": policy
            }));
            let pods = start(&mut job);
            job.terminating(pods[0].0);
            assert_eq!(job.next_pod().is_some(), early, "{policy}");
            job.ended(pods[0].0, &exit(143));
            assert_eq!(job.next_pod(), Some(Some(0)), "{policy}");
        }
    }

    #[test]
    fn indexes_are_single_numbers_and_ranges() {
        assert_eq!(parse_indexes("0,2-3,7"), BTreeSet::from([0, 2, 3, 7]));
    }
}
