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

# add_module(name SOURCES a.cpp b.cpp DEPENDS other_modules PRIVATE_DEPENDS libraries)
function(add_module name)
  cmake_parse_arguments(M "" "" "SOURCES;DEPENDS;PRIVATE_DEPENDS" ${ARGN})
  add_library(${name} STATIC ${M_SOURCES})
  target_link_libraries(${name} PUBLIC chiaro_settings ${M_DEPENDS} PRIVATE chiaro_warnings ${M_PRIVATE_DEPENDS})
endfunction()

# add_chiaro_test(name SOURCES a_test.cpp DEPENDS modules [LABELS unit]); ctest shows folder.Suite.Name
function(add_chiaro_test name)
  cmake_parse_arguments(T "" "" "SOURCES;DEPENDS;LABELS" ${ARGN})
  add_executable(${name}_test ${T_SOURCES})
  target_link_libraries(${name}_test PRIVATE ${T_DEPENDS} chiaro_warnings GTest::gtest GTest::gmock GTest::gtest_main)
  set(labels unit)
  if(T_LABELS)
    set(labels ${T_LABELS})
  endif()
  gtest_discover_tests(${name}_test TEST_PREFIX "${name}." DISCOVERY_TIMEOUT 60 DISCOVERY_MODE PRE_TEST
    PROPERTIES LABELS "${labels}" TIMEOUT 600)
endfunction()
