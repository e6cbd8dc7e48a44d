# ROS 2 Jazzy with thinmap, built in a workspace as "In your ROS 2 workspace" of docs/how_to/install.md says:
#   docker build -t thinmap .
#   docker run --rm -it --net=host --ipc=host thinmap ros2 run thinmap_ros thinmap
# Not built yet where this file was written: no Docker daemon ran there.
FROM ros:jazzy-ros-base
SHELL ["/bin/bash", "-c"]
WORKDIR /ws
# rosdep installs what rosdep.yaml names with pip, beside the packages of the system.
ENV PIP_BREAK_SYSTEM_PACKAGES=1
COPY . src/thinmap
RUN echo "yaml file:///ws/src/thinmap/rosdep.yaml" > /etc/ros/rosdep/sources.list.d/50-thinmap.list \
  && apt-get update && rosdep update \
  && rosdep install --from-paths src/thinmap src/thinmap/thinmap_msgs --ignore-src -y \
  && rm -rf /var/lib/apt/lists/*
RUN source /opt/ros/jazzy/setup.bash \
  && colcon build --base-paths src/thinmap src/thinmap/thinmap_msgs \
  && source install/setup.bash && thinmap warm_up
RUN sed -i 's|^exec|source /ws/install/setup.bash\nexec|' /ros_entrypoint.sh
WORKDIR /root
CMD ["ros2", "run", "thinmap_ros", "thinmap"]
