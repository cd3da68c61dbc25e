# Settings that every target shares, and the one helper the folders use.
add_library(chiaro_warnings INTERFACE)
target_compile_options(chiaro_warnings INTERFACE -Wall -Wextra -Wpedantic -Wconversion -Wshadow -Wno-sign-conversion
  $<$<BOOL:${CHIARO_WERROR}>:-Werror>)

add_library(chiaro_settings INTERFACE)
target_include_directories(chiaro_settings INTERFACE ${CMAKE_SOURCE_DIR})
# Plain IEEE arithmetic: builds must not differ in their bits. -fno-math-errno and -fno-trapping-math change no result.
target_compile_options(chiaro_settings INTERFACE -ffp-contract=off -fno-math-errno -fno-trapping-math)
target_link_libraries(chiaro_settings INTERFACE Eigen3::Eigen Threads::Threads)
target_compile_definitions(chiaro_settings INTERFACE EIGEN_DONT_PARALLELIZE EIGEN_MAX_ALIGN_BYTES=16)

# With CHIARO_PCH, headers that nearly every file reads are parsed once for all libraries (-fPIC) and once for all tests (-fPIE). Compiling everything takes a
# third less time; but a missing include goes unseen. So it is for builds from scratch: the scripts for newcomers turn it on. ccache follows if
# CCACHE_SLOPPINESS says pch_defines,time_macros.
set(CHIARO_PCH_HEADERS <algorithm> <cmath> <filesystem> <functional> <map> <memory> <optional> <span> <string> <vector> <Eigen/Core> <Eigen/Geometry> <nlohmann/json.hpp>)
if(CHIARO_PCH)
  file(WRITE ${CMAKE_BINARY_DIR}/pch.cpp "int main() {}\n")
  add_library(chiaro_pch STATIC ${CMAKE_BINARY_DIR}/pch.cpp)
  target_link_libraries(chiaro_pch PRIVATE chiaro_settings chiaro_warnings)
  target_precompile_headers(chiaro_pch PRIVATE ${CHIARO_PCH_HEADERS})
  if(CMAKE_CXX_COMPILER_ID STREQUAL "GNU")
    target_compile_options(chiaro_settings INTERFACE -fpch-preprocess)
  endif()
endif()
function(use_pch name from)
  if(CHIARO_PCH)
    target_precompile_headers(${name} REUSE_FROM ${from})
  endif()
endfunction()

# add_module(name SOURCES a.cpp b.cpp DEPENDS other_modules PRIVATE_DEPENDS libraries)
function(add_module name)
  cmake_parse_arguments(M "" "" "SOURCES;DEPENDS;PRIVATE_DEPENDS" ${ARGN})
  add_library(${name} STATIC ${M_SOURCES})
  target_link_libraries(${name} PUBLIC chiaro_settings ${M_DEPENDS} PRIVATE chiaro_warnings ${M_PRIVATE_DEPENDS})
  use_pch(${name} chiaro_pch)
endfunction()

# add_chiaro_test(name SOURCES a_test.cpp DEPENDS modules [LABELS unit]); ctest shows folder.Suite.Name
function(add_chiaro_test name)
  cmake_parse_arguments(T "" "" "SOURCES;DEPENDS;LABELS" ${ARGN})
  if(CHIARO_PCH AND NOT TARGET chiaro_test_pch)
    add_executable(chiaro_test_pch ${CMAKE_BINARY_DIR}/pch.cpp)
    target_link_libraries(chiaro_test_pch PRIVATE chiaro_settings chiaro_warnings GTest::gtest GTest::gmock)
    target_precompile_headers(chiaro_test_pch PRIVATE ${CHIARO_PCH_HEADERS} <gmock/gmock.h> <gtest/gtest.h>)
    target_compile_options(chiaro_test_pch PRIVATE ${CHIARO_TEST_FLAGS})
  endif()
  add_executable(${name}_test ${T_SOURCES})
  use_pch(${name}_test chiaro_test_pch)
  target_compile_options(${name}_test PRIVATE ${CHIARO_TEST_FLAGS})
  target_link_libraries(${name}_test PRIVATE ${T_DEPENDS} chiaro_warnings GTest::gtest GTest::gmock GTest::gtest_main)
  set(labels unit)
  if(T_LABELS)
    set(labels ${T_LABELS})
  endif()
  gtest_discover_tests(${name}_test TEST_PREFIX "${name}." DISCOVERY_TIMEOUT 60 DISCOVERY_MODE PRE_TEST
    PROPERTIES LABELS "${labels}" TIMEOUT 600)
endfunction()
