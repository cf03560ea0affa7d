# ROS 2 Jazzy with the controller's node and the simulated robot; docs/install.md says how to use it.
FROM ros:jazzy-ros-base AS robot

# gcc compiles functions of yours (costs, limits, models).
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install --yes --no-install-recommends gcc libc6-dev python3-venv \
    && rm -rf /var/lib/apt/lists/*

# Beside ROS's own Python 3.12 and NumPy 1.26, with the pins of requirements.txt; rclpy is ROS's, not the wheels'.
COPY . /source
RUN python3 -m venv --system-site-packages /opt/diffdrive-mpc \
    && sed -e 's/ \\$//' -e '/--hash=/d' -e '/^ *#/d' /source/requirements.txt > /tmp/pins.txt \
    && /opt/diffdrive-mpc/bin/pip install --no-cache-dir --constraint /tmp/pins.txt /source \
    && rm -r /source/build /tmp/pins.txt

# colcon runs with that Python, so that the node's script starts with it.
RUN mkdir -p /workspace/src \
    && cp -r /source/ros /workspace/src/diffdrive_mpc_ros
WORKDIR /workspace
RUN . /opt/ros/jazzy/setup.sh \
    && /opt/diffdrive-mpc/bin/python /usr/bin/colcon build

COPY docker/entrypoint.sh docker/drive.sh /usr/local/bin/
ENV PATH=/opt/diffdrive-mpc/bin:$PATH
RUN id ubuntu 2>/dev/null || useradd --create-home --uid 1000 --shell /bin/bash ubuntu
USER ubuntu
WORKDIR /home/ubuntu
ENTRYPOINT ["entrypoint.sh"]
CMD ["diffdrive-mpc", "doctor"]

# What the tests and the export to a microcontroller need, too.
FROM robot AS development
USER root
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install --yes --no-install-recommends \
        cmake gcc-arm-none-eabi git libnewlib-arm-none-eabi make qemu-system-arm sudo \
    && rm -rf /var/lib/apt/lists/* \
    && echo "ubuntu ALL=(ALL) NOPASSWD: ALL" > /etc/sudoers.d/ubuntu
USER ubuntu
ENTRYPOINT []
CMD ["bash"]
