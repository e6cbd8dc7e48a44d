# Only the generators of messages for rclpy: no node here is written in C++. Each generator is a pass of Python over all
# messages, and a library. They are found before a project asks for its own, so that what is defined here counts.
find_package(rosidl_default_generators REQUIRED)

macro(ament_execute_extensions point)
  list(FILTER AMENT_EXTENSIONS_rosidl_generate_idl_interfaces EXCLUDE REGEX "_cpp:")
  _ament_execute_extensions(${point} ${ARGN})
endmacro()

# rclpy loads this one, which finds that of the middleware.
macro(rosidl_generator_py_get_typesupports implementations)
  set(${implementations} rosidl_typesupport_c)
endmacro()

# Messages are converted as fast as with -O3.
foreach(language C CXX)
  set(CMAKE_${language}_FLAGS_RELEASE "-O1 -DNDEBUG")
endforeach()
