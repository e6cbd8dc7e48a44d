# Named by CMAKE_TOOLCHAIN_FILE in the environment: the one way to reach every project that colcon configures.
set(CMAKE_PROJECT_INCLUDE "${CMAKE_CURRENT_LIST_DIR}/wheel_includes.cmake")
