include(${CMAKE_CURRENT_LIST_DIR}/FindZeroMQLibrary.cmake)
include(${CMAKE_CURRENT_LIST_DIR}/handtouchTargets.cmake)
