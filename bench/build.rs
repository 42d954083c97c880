//! Compiles the allocator of `traffic-bridge`, mimalloc, as a shared library that bare SUMO is run with.
//!
//! It is compiled from the sources that `libmimalloc-sys` carries, with the options of that crate's own build.

use std::{
    env,
    path::{Path, PathBuf},
    process::exit,
};

fn main() {
    println!("cargo:rerun-if-changed=build.rs");
    let variable = |name: &str| {
        env::var_os(name).map_or_else(
            || {
                println!("cargo::error=cargo did not set {name}");
                exit(1)
            },
            PathBuf::from,
        )
    };
    let sources = variable("DEP_MIMALLOC_INCLUDE_DIR").join("../src");
    let library = variable("OUT_DIR").join("libcaraware-mimalloc.so");
    compile(&sources, &library);
    println!("cargo:rustc-env=CARAWARE_MIMALLOC={}", library.display());
}

fn compile(sources: &Path, library: &Path) {
    let mut build = cc::Build::new();
    build
        .include(sources.join("../include"))
        .include(sources)
        .opt_level(3)
        .define("MI_MALLOC_OVERRIDE", None)
        .define("MI_SHARED_LIB", None)
        .define("MI_SHARED_LIB_EXPORT", None)
        .define("MI_DEBUG", "0")
        .define("MI_BUILD_RELEASE", None)
        .define("NDEBUG", None)
        .flag_if_supported("-fno-builtin-malloc")
        .flag_if_supported("-ftls-model=initial-exec")
        .warnings(false);
    let mut command = build.get_compiler().to_command();
    command
        .arg("-shared")
        .arg(sources.join("static.c"))
        .arg("-o")
        .arg(library)
        .arg("-lpthread");
    match command.status() {
        Ok(status) if status.success() => {}
        ended => {
            println!("cargo::error=cannot compile mimalloc as a shared library: {ended:?}");
            exit(1);
        }
    }
}
