# Target handtouch::zmq: libzmq, which Debian installs without a CMake package.
if(NOT TARGET handtouch::zmq)
  find_path(HANDTOUCH_ZMQ_INCLUDE zmq.h REQUIRED)
  find_library(HANDTOUCH_ZMQ_LIBRARY zmq REQUIRED)
  add_library(handtouch::zmq UNKNOWN IMPORTED)
  set_target_properties(handtouch::zmq PROPERTIES
    IMPORTED_LOCATION ${HANDTOUCH_ZMQ_LIBRARY} INTERFACE_INCLUDE_DIRECTORIES ${HANDTOUCH_ZMQ_INCLUDE})
endif()
