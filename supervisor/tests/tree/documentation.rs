//! The pages: every link and path leads somewhere, every command line and its settings parse, prose wraps at 100 columns.

use std::path::{Path, PathBuf};

use caraware::{
    cli::{Cli, RunArgs, Subcommands},
    config::{ConfigError, LayeredSettings},
};
use clap::{Parser as _, error::ErrorKind};

const ROOT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/..");

/// Widest line of prose, columns.
const COLUMNS: usize = 100;

/// Directories without pages of the project.
const SKIPPED: [&str; 3] = ["target", "runs", "node_modules"];

/// One page of the project.
struct Page {
    path: PathBuf,
    text: String,
}

impl Page {
    fn read(path: PathBuf) -> Self {
        let text = std::fs::read_to_string(&path).unwrap();
        Self { path, text }
    }

    fn name(&self) -> &str {
        self.path.file_name().unwrap().to_str().unwrap()
    }

    /// Each line with its number, from 1, and the language of the code block that it is in, if any.
    fn lines(&self) -> Vec<(usize, &str, Option<&str>)> {
        let mut language = None;
        let mut lines = Vec::new();
        for (index, line) in self.text.lines().enumerate() {
            let fence = line.trim_start().strip_prefix("```");
            match (fence, language) {
                (Some(_), Some(_)) => language = None,
                (Some(name), None) => language = Some(name.trim()),
                (None, _) => lines.push((index + 1, line, language)),
            }
        }
        lines
    }

    /// Lines outside code blocks.
    fn prose(&self) -> impl Iterator<Item = (usize, &str)> {
        let lines = self.lines().into_iter();
        lines
            .filter(|(.., language)| language.is_none())
            .map(|(number, line, _)| (number, line))
    }

    /// The anchors of its headings, as GitHub makes them.
    fn anchors(&self) -> Vec<String> {
        let headings = self.prose().filter(|(_, line)| line.starts_with('#'));
        headings
            .map(|(_, line)| {
                let title = line.trim_start_matches('#').trim().to_lowercase();
                let kept = title.chars().filter(|c| c.is_alphanumeric() || " -_".contains(*c));
                kept.map(|c| if c == ' ' { '-' } else { c }).collect()
            })
            .collect()
    }
}

/// Every Markdown file of the working tree.
fn pages() -> Vec<Page> {
    let mut pages = Vec::new();
    let mut directories = vec![PathBuf::from(ROOT)];
    while let Some(directory) = directories.pop() {
        for entry in std::fs::read_dir(&directory).unwrap() {
            let path = entry.unwrap().path();
            let name = path.file_name().unwrap().to_str().unwrap_or_default();
            if name.starts_with('.') || SKIPPED.contains(&name) || path.is_symlink() {
                continue;
            }
            if path.is_dir() {
                directories.push(path);
            } else if name.ends_with(".md") {
                pages.push(Page::read(path));
            }
        }
    }
    assert!(pages.len() > 20, "{} pages below {ROOT}", pages.len());
    pages
}

/// What stands between `open` and `close` in a line, each time.
fn between<'a>(line: &'a str, open: &str, close: char) -> Vec<&'a str> {
    let parts = line.split(open).skip(1);
    parts.filter_map(|part| part.split(close).next()).collect()
}

/// What stands between backticks in a line.
fn code_spans(line: &str) -> impl Iterator<Item = &str> {
    line.split('`').skip(1).step_by(2)
}

fn assert_none(faults: &[String]) {
    assert!(faults.is_empty(), "\n{}", faults.join("\n"));
}

#[test]
fn every_relative_link_leads_to_a_file_and_its_heading() {
    let mut dead = Vec::new();
    for page in pages() {
        for (number, line) in page.prose() {
            for link in between(line, "](", ')') {
                // `parts.md` is included in the page above it.
                if link.contains("://") || page.name() == "parts.md" {
                    continue;
                }
                let (target, anchor) = link.split_once('#').unwrap_or((link, ""));
                let path = match target {
                    "" => page.path.clone(),
                    target => page.path.parent().unwrap().join(target),
                };
                let has_anchor = || anchor.is_empty() || Page::read(path.clone()).anchors().iter().any(|a| a == anchor);
                if !path.exists() || !has_anchor() {
                    dead.push(format!("{}:{number}: {link}", page.path.display()));
                }
            }
        }
    }
    assert_none(&dead);
}

/// Paths in backticks that begin with a directory of the repository; `NAME` and `<…>` stand for what a reader chooses.
#[test]
fn every_path_that_the_architecture_and_the_recipes_name_exists() {
    let mut missing = Vec::new();
    for name in ["ARCHITECTURE.md", "README.md", "docs/extending.md"] {
        let page = Page::read(Path::new(ROOT).join(name));
        for (number, line) in page.prose() {
            for span in code_spans(line) {
                let Some((first, _)) = span.split_once('/') else {
                    continue;
                };
                let is_ours = !SKIPPED.contains(&first) && Path::new(ROOT).join(first).is_dir();
                let is_open = ["NAME", "<", "…", " "].iter().any(|mark| span.contains(mark));
                if is_ours && !is_open && !Path::new(ROOT).join(span).exists() {
                    missing.push(format!("{name}:{number}: {span}"));
                }
            }
        }
    }
    assert_none(&missing);
}

/// The words of a command line up to its comment; `None` if it is only an outline (`…`) or needs a shell's quotes.
fn words(line: &str) -> Option<Vec<&str>> {
    if line.contains(['…', '"', '\'', '$', '|', '&', '<']) {
        return None;
    }
    let words = line.split_whitespace().take_while(|word| !word.starts_with('#'));
    Some(words.collect())
}

/// The command line of `caraware` that a line of a shell script is, if it is one: without the variables before it and the path of
/// the program. `torchrun … -m caraware.parallel` takes the arguments of `caraware train`.
fn command_line(line: &str) -> Option<String> {
    if let Some((_, arguments)) = line.split_once("-m caraware.parallel ") {
        return Some(format!("caraware train {arguments}"));
    }
    let is_assignment = |word: &str| word.contains('=') && word.starts_with(|c: char| c.is_ascii_uppercase());
    let mut words = line.split(' ').skip_while(|word| is_assignment(word));
    let program = words.next()?;
    let is_caraware = program == "caraware" || program.ends_with("/caraware");
    is_caraware.then(|| format!("caraware {}", words.collect::<Vec<_>>().join(" ")))
}

/// Why `caraware` would refuse this command line. A mention such as `caraware generate` may leave out what is required.
fn refusal(line: &str, is_mention: bool) -> Option<String> {
    // `KEY=N` stands for a number.
    let line = line.replace("=N", "=1");
    let words = words(&line)?;
    let error = match Cli::try_parse_from(words) {
        Ok(cli) => return settings_refusal(&cli),
        Err(error) => error,
    };
    let is_help = matches!(
        error.kind(),
        ErrorKind::DisplayHelp | ErrorKind::DisplayVersion | ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand
    );
    let is_short = is_mention
        && matches!(
            error.kind(),
            ErrorKind::MissingRequiredArgument | ErrorKind::MissingSubcommand
        );
    (!is_help && !is_short).then(|| error.to_string())
}

/// Why the settings of a command line would be refused.
fn settings_refusal(cli: &Cli) -> Option<String> {
    let only_settings = |set: &[String]| RunArgs {
        set: set.to_vec(),
        ..RunArgs::default()
    };
    let run = match &cli.command {
        Subcommands::Train(train) => train.run.clone(),
        Subcommands::Simulate(run) => run.clone(),
        Subcommands::Play(play) => play.run.clone(),
        Subcommands::Handover(handover) => only_settings(&handover.set),
        Subcommands::Replay(replay) => only_settings(&replay.set),
        _ => return None,
    };
    validated(&run).err()
}

/// Validates the settings of a run as its start does, on its preset. Files that only the reader has are left out.
fn validated(run: &RunArgs) -> Result<(), String> {
    let text = |error: ConfigError| format!("{:?}", miette::Report::new(error));
    let run = run.with_shorthands().map_err(|error| format!("{error:?}"))?;
    let mut settings = LayeredSettings::defaults().map_err(text)?;
    if let Some(preset) = &run.preset {
        settings = settings.with_named_preset(preset).map_err(text)?;
    } else if let Some(config) = &run.config {
        match settings.clone().with_preset(config) {
            Some(preset) => settings = preset.map_err(text)?,
            None if config.contains('.') || config == "CONFIG" || config == "SCENARIO" => {}
            None => return Err(format!("there is no preset {config}")),
        }
    }
    let settings = settings.with_assignments(&run.set).map_err(text)?;
    settings.validate().map(drop).map_err(text)
}

/// A block `toml` of a page is a configuration file, whole.
#[test]
fn every_configuration_is_valid() {
    let file = Path::new(env!("CARGO_TARGET_TMPDIR")).join("documentation.toml");
    let (mut refused, mut count) = (Vec::new(), 0);
    for page in pages() {
        let (mut begin, mut block) = (0, String::new());
        // The line behind the last one ends a block at the end of a page.
        let lines = page.lines().into_iter().chain([(usize::MAX, "", None)]);
        for (number, line, language) in lines {
            if language == Some("toml") {
                begin = if block.is_empty() { number } else { begin };
                block += line;
                block += "\n";
                continue;
            }
            if block.is_empty() {
                continue;
            }
            count += 1;
            std::fs::write(&file, std::mem::take(&mut block)).unwrap();
            let settings = LayeredSettings::defaults().and_then(|settings| settings.with_file(&file, None));
            if let Err(error) = settings.and_then(|settings| settings.validate()) {
                let why = miette::Report::new(error);
                refused.push(format!("{}:{begin}: {why:?}", page.path.display()));
            }
        }
    }
    assert!(count > 8, "{count} configurations found");
    assert_none(&refused);
}

#[test]
fn every_command_line_parses() {
    let mut refused = Vec::new();
    let mut count = 0;
    for page in pages() {
        // Its commands are those that made its figures.
        if page.name() == "benchmarks.md" {
            continue;
        }
        let mut check = |number: usize, line: &str, is_mention: bool| {
            count += 1;
            if let Some(why) = refusal(line, is_mention) {
                refused.push(format!("{}:{number}: {line}\n  {why}", page.path.display()));
            }
        };
        let mut begun = String::new();
        for (number, line, language) in page.lines() {
            match language {
                None => code_spans(line)
                    .filter(|span| span.starts_with("caraware "))
                    .for_each(|span| check(number, span, true)),
                Some("sh" | "bash" | "text") => {
                    begun += match line.strip_prefix("$ ") {
                        Some(command) => command,
                        // What a command prints is not one.
                        None if language == Some("text") => continue,
                        None => line.trim_start(),
                    };
                    if let Some(continued) = begun.strip_suffix('\\') {
                        begun = continued.to_owned();
                        continue;
                    }
                    if let Some(command) = command_line(&begun) {
                        check(number, &command, false);
                    }
                    begun.clear();
                }
                Some(_) => {}
            }
        }
    }
    assert!(count > 50, "{count} command lines found");
    assert_none(&refused);
}

/// True if code spans and links leave nowhere to break the line.
fn is_unbreakable(text: &str) -> bool {
    let outside_code = text.split('`').step_by(2);
    outside_code.flat_map(str::split_whitespace).count() <= 4
}

/// Tables, pictures, headings and single words that are longer stay as they are.
#[test]
fn prose_wraps_at_100_columns() {
    let mut wide = Vec::new();
    for page in pages() {
        // Generated from the reports, a paragraph a line.
        if page.name() == "benchmarks.md" {
            continue;
        }
        for (number, line) in page.prose() {
            let text = line.trim_start();
            let is_exempt = text.starts_with(['|', '!', '#', '<']) || is_unbreakable(text);
            if line.chars().count() > COLUMNS && !is_exempt {
                wide.push(format!(
                    "{}:{number}: {} columns",
                    page.path.display(),
                    line.chars().count()
                ));
            }
        }
    }
    assert_none(&wide);
}

#[test]
fn the_readme_is_a_page_that_begins_with_the_two_commands() {
    let readme = Page::read(Path::new(ROOT).join("README.md"));
    let lines: Vec<&str> = readme.text.lines().collect();
    assert!(lines.len() <= 160, "{} lines", lines.len());
    let commands = lines.iter().filter(|line| line.starts_with("make "));
    let commands: Vec<&str> = commands.filter_map(|line| line.split("  ").next()).collect();
    assert_eq!(commands, ["make train", "make test"]);
    assert_eq!(lines[2..4], ["```sh", lines[3]]);
}
