# The generated C++ sources of messages spend most of their compilation on headers that they share: the sources of a
# library are compiled together. They declare some functions again, of which the compiler would warn then.
function(thinmap_join_sources)
  get_property(targets DIRECTORY PROPERTY BUILDSYSTEM_TARGETS)
  foreach(target IN LISTS targets)
    if(target MATCHES "__rosidl_typesupport_(fastrtps_c|c)$")
      set_target_properties(${target} PROPERTIES UNITY_BUILD ON UNITY_BUILD_BATCH_SIZE 0)
      target_compile_options(${target} PRIVATE $<$<COMPILE_LANGUAGE:CXX>:-Wno-redundant-decls>)
    endif()
  endforeach()
endfunction()
cmake_language(DEFER CALL thinmap_join_sources)
