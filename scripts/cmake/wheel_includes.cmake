# ROS wheels export CMake targets that list the header folders of the machine on which they were made. CMake stops at
# folders that do not exist, so they are taken off every imported target once the project has found its packages.
function(thinmap_drop_missing_includes)
  get_property(targets DIRECTORY PROPERTY IMPORTED_TARGETS)
  foreach(target IN LISTS targets)
    get_target_property(folders ${target} INTERFACE_INCLUDE_DIRECTORIES)
    if(NOT folders MATCHES "(^|;)/opt/python/")
      continue()
    endif()
    list(FILTER folders EXCLUDE REGEX "^/opt/python/")
    set_target_properties(${target} PROPERTIES INTERFACE_INCLUDE_DIRECTORIES "${folders}")
  endforeach()
endfunction()
cmake_language(DEFER CALL thinmap_drop_missing_includes)
