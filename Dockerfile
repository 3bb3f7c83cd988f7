# Ubuntu 24.04 with ROS 2 Jazzy and the package, compiled: the first start of the node takes seconds.
#   docker build -t eskf_ros .
#   docker run --rm --network host -v "$PWD/my_robot.yaml:/my_robot.yaml:ro" eskf_ros \
#       ros2 launch eskf_ros eskf.launch.py params_file:=/my_robot.yaml
#   docker run --rm eskf_ros bash -c \
#       'cd /ros2_ws/install/eskf_ros/share/eskf_ros && ros2 run eskf_ros eskf_replay bags/tunnel_drive.mcap \
#        --config config/tunnel_drive.yaml --out /tmp'
FROM ros:jazzy-ros-base-noble

# "generic": the machine code fits every processor of this kind, not only the one the image is built on. Set to
# "host", it is that of the building machine.
ARG NUMBA_CPU_NAME=generic
ENV NUMBA_CPU_NAME=${NUMBA_CPU_NAME}

SHELL ["/bin/bash", "-o", "pipefail", "-c"]
WORKDIR /ros2_ws

# What it depends on comes first, so that an edit of the sources installs nothing again. Two packages come from PyPI.
COPY package.xml src/eskf_ros/
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install --yes --no-install-recommends python3-pip \
    && rosdep update --rosdistro jazzy \
    && PIP_BREAK_SYSTEM_PACKAGES=1 PIP_NO_CACHE_DIR=1 \
        rosdep install --from-paths src --ignore-src --dependency-types exec --rosdistro jazzy -y \
    && rm -rf /var/lib/apt/lists/*

COPY . src/eskf_ros
RUN source /opt/ros/jazzy/setup.bash \
    && colcon build --packages-select eskf_ros \
    && rm -rf build log

ENTRYPOINT ["/bin/bash", "-c", "source /ros2_ws/install/setup.bash && exec \"$@\"", "--"]
CMD ["ros2", "launch", "eskf_ros", "eskf.launch.py"]
