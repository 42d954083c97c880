//! Compiles the shim against the `eclipse-sumo` wheel, which carries SUMO's headers and its shared library.

use std::{
    env,
    path::{Path, PathBuf},
    process::exit,
};

/// Names the wheel's `sumo` directory when it is not in the project's own virtual environment.
const SUMO_HOME_VARIABLE: &str = "CARAWARE_SUMO_HOME";

fn main() {
    for file in [
        "libsumo.rs",
        "shim.h",
        "shim.cc",
        "population.cc",
        "heroes.cc",
        "over_traci.cc",
        "xml_paths.cc",
        "engine.h",
        "lanes.h",
        "error_tee.h",
        "text.h",
        "vehicle_object.h",
    ] {
        println!("cargo:rerun-if-changed=src/sumo/{file}");
    }
    println!("cargo:rerun-if-env-changed={SUMO_HOME_VARIABLE}");
    let Some(sumo) = sumo_home() else {
        println!(
            "cargo::error=SUMO is not installed: no `sumo/include/libsumo` in .venv/lib/python3*/site-packages; \
             run `make build`, or set {SUMO_HOME_VARIABLE} to the `sumo` directory of the eclipse-sumo==1.28.0 wheel"
        );
        exit(1);
    };
    cxx_build::bridge("src/sumo/libsumo.rs")
        .files([
            "src/sumo/shim.cc",
            "src/sumo/population.cc",
            "src/sumo/heroes.cc",
            "src/sumo/over_traci.cc",
            "src/sumo/xml_paths.cc",
        ])
        .std("c++17")
        .include(sumo.join("include"))
        .flag_if_supported("-Wno-unused-parameter")
        .compile("traffic-bridge-shim");
    link(&sumo);
}

fn link(sumo: &Path) {
    let library = sumo.join("lib64");
    println!("cargo:rerun-if-changed={}", library.join("libsumocpp.so").display());
    println!("cargo:rustc-link-search=native={}", library.display());
    println!("cargo:rustc-link-lib=dylib=sumocpp");
    println!("cargo:rustc-link-lib=dylib=tracicpp");
    println!("cargo:rustc-link-arg=-Wl,-rpath,{}", library.display());
    // Where the wheel of the trainer has the program, from `caraware/programs` (trainer/setup.py).
    println!("cargo:rustc-link-arg=-Wl,-rpath,$ORIGIN/../../sumo/lib64");
    // Tests and examples find the wheel's scenarios and tools here; the program itself reads the path from its run file.
    println!("cargo:rustc-env=CARAWARE_BUILD_SUMO_HOME={}", sumo.display());
}

fn sumo_home() -> Option<PathBuf> {
    let named = env::var_os(SUMO_HOME_VARIABLE)
        .filter(|path| !path.is_empty())
        .map(PathBuf::from);
    named
        .or_else(virtual_environment)
        .filter(|sumo| sumo.join("include/libsumo/libsumo.h").is_file())
}

fn virtual_environment() -> Option<PathBuf> {
    let root = PathBuf::from(env::var_os("CARGO_MANIFEST_DIR")?);
    let environment = root.parent()?.join(".venv");
    println!("cargo:rerun-if-changed={}", environment.join("pyvenv.cfg").display());
    let mut found: Vec<PathBuf> = std::fs::read_dir(environment.join("lib"))
        .ok()?
        .filter_map(|entry| Some(entry.ok()?.path().join("site-packages/sumo")))
        .filter(|sumo| sumo.is_dir())
        .collect();
    found.sort();
    found.pop()
}
