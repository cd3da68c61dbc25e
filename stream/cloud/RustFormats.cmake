# LAZ and E57 through Rust crates, where cargo is there and has the crates or can fetch them; chiaro builds without too, and says so when it meets such a
# file. Sets CHIARO_RUST_LIBRARY to the static library, or to nothing.
option(CHIARO_RUST_FORMATS "Read LAZ and E57 (needs cargo)" ON)
set(CHIARO_RUST_LIBRARY)
set(least_rust 1.82)

function(find_rust result)
  set(${result} "" PARENT_SCOPE)
  find_program(CARGO cargo)
  find_program(RUSTC rustc)
  if(NOT CARGO OR NOT RUSTC)
    message(WARNING "cargo or rustc is missing: LAZ and E57 will not be read (on Debian 12: apt-get install cargo-web rustc-web)")
    return()
  endif()
  execute_process(COMMAND ${RUSTC} --version OUTPUT_VARIABLE version ERROR_QUIET)
  string(REGEX MATCH "[0-9]+\\.[0-9]+" version "${version}")
  if(NOT version OR version VERSION_LESS least_rust)
    message(WARNING "rustc ${version} is older than ${least_rust}: LAZ and E57 will not be read (on Debian 12: apt-get install cargo-web rustc-web)")
    return()
  endif()
  # What was fetched once needs no network again.
  foreach(network --offline "")
    execute_process(COMMAND ${CARGO} fetch --locked --quiet ${network} --manifest-path ${manifest} RESULT_VARIABLE failed ERROR_VARIABLE why OUTPUT_QUIET)
    if(NOT failed)
      set(${result} ${CARGO} PARENT_SCOPE)
      return()
    endif()
  endforeach()
  message(WARNING "cargo cannot fetch the crates that read LAZ and E57; they will not be read:\n${why}")
endfunction()

if(CHIARO_RUST_FORMATS)
  set(manifest ${CMAKE_CURRENT_SOURCE_DIR}/rust_formats/Cargo.toml)
  find_rust(cargo)
  if(cargo)
    set(folder ${CMAKE_BINARY_DIR}/rust_formats)
    cmake_path(IS_PREFIX CMAKE_SOURCE_DIR ${CMAKE_BINARY_DIR} presets)
    if(presets)   # the same for all of build/release, build/asan, ...
      cmake_path(SET folder NORMALIZE ${CMAKE_BINARY_DIR}/../rust_formats)
    endif()
    set(CHIARO_RUST_LIBRARY ${folder}/release/libchiaro_rust_formats.a)
    set(rust_sources e57_scans.rs file_at.rs laz_chunks.rs lib.rs pages.rs)
    list(TRANSFORM rust_sources PREPEND ${CMAKE_CURRENT_SOURCE_DIR}/rust_formats/src/)
    # touch: cargo leaves the library alone where nothing changed in it, and ninja would ask again.
    add_custom_command(OUTPUT ${CHIARO_RUST_LIBRARY}
      COMMAND ${cargo} build --locked --offline --release --quiet --manifest-path ${manifest} --target-dir ${folder}
      COMMAND ${CMAKE_COMMAND} -E touch ${CHIARO_RUST_LIBRARY}
      DEPENDS ${manifest} ${CMAKE_CURRENT_SOURCE_DIR}/rust_formats/Cargo.lock ${rust_sources}
      COMMENT "Building the readers of LAZ and E57 with cargo" VERBATIM)
    add_custom_target(chiaro_rust_formats DEPENDS ${CHIARO_RUST_LIBRARY})
  endif()
endif()
