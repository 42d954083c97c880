use std::io::Write;

use super::*;

fn course() -> (tempfile::TempDir, LearningCourse) {
    let directory = tempfile::tempdir().unwrap();
    let course = LearningCourse {
        path: directory.path().join(FILE_NAME),
        head: "{\"schema_version\":1".into(),
        inode: 0,
        read_bytes: 0,
        updates: SparseLines::default(),
        evaluations: SparseLines::default(),
    };
    (directory, course)
}

fn append(course: &LearningCourse, text: &str) {
    let mut file = File::options().create(true).append(true).open(&course.path).unwrap();
    file.write_all(text.as_bytes()).unwrap();
}

fn steps(document: &[u8], kind: &str) -> Vec<u64> {
    let value: serde_json::Value = serde_json::from_slice(document).unwrap();
    let lines = value[kind].as_array().unwrap();
    lines.iter().map(|line| line["env_steps"].as_u64().unwrap()).collect()
}

fn update(env_steps: usize) -> String {
    format!("{{\"env_steps\":{env_steps},\"tick\":1,\"training\":{{}}}}\n")
}

#[test]
fn lines_are_read_once_they_are_complete() {
    let (_directory, mut course) = course();
    assert_eq!(course.read_new(), None);
    append(&course, &(update(1) + "{\"env_steps\":2,"));
    let (_, whole) = course.read_new().unwrap();
    assert_eq!(steps(&whole, "updates"), [1]);
    assert_eq!(course.read_new(), None);
    append(&course, "\"evaluation\":{}}\nnonsense\n[1]\n");
    let (_, whole) = course.read_new().unwrap();
    assert_eq!(
        (steps(&whole, "updates"), steps(&whole, "evaluations")),
        (vec![1], vec![2])
    );
}

#[test]
fn a_replaced_file_is_read_from_its_start() {
    let (directory, mut course) = course();
    append(&course, &(update(1) + &update(2)));
    course.read_new().unwrap();
    let beside = directory.path().join("new");
    std::fs::write(&beside, update(1) + &update(5) + &update(6)).unwrap();
    std::fs::rename(beside, &course.path).unwrap();
    assert_eq!(steps(&course.read_new().unwrap().1, "updates"), [1, 5, 6]);
}

#[test]
fn a_long_run_keeps_its_first_and_newest_lines_within_a_bound() {
    let (_directory, mut course) = course();
    let mut all = 0;
    for _ in 0..9 {
        append(&course, &(0..1111).map(|i| update(all + i)).collect::<String>());
        all += 1111;
        let (part, whole) = course.read_new().unwrap();
        let kept = steps(&whole, "updates");
        assert!(
            kept.len() <= MAX_LINES + 1 && kept.len() > MAX_LINES / 3,
            "{}",
            kept.len()
        );
        assert_eq!((kept[0], *kept.last().unwrap()), (0, all as u64 - 1));
        assert!(kept.is_sorted_by(|a, b| a < b));
        assert!(kept.ends_with(&steps(&part, "updates")));
        let gaps: Vec<u64> = kept.windows(2).map(|two| two[1] - two[0]).collect();
        assert!(gaps[..gaps.len() - 1].iter().all(|gap| *gap == gaps[0]));
    }
}
