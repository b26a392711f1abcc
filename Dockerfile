# sdfsim on a CPU, made from this checkout:
#   docker build -t sdfsim .
#   docker run --rm -v "$PWD:/work" -v sdfsim:/root/.cache sdfsim simulate tower -o run
# The volume `sdfsim` keeps compiled code, so that only the first run compiles.
FROM debian:bookworm-slim AS build
RUN apt-get update && apt-get install -y --no-install-recommends python3 python3-venv
COPY . /source
# torch without CUDA, which saves several GB
RUN python3 -m venv /opt/sdfsim && \
    /opt/sdfsim/bin/pip install --no-cache-dir --extra-index-url https://download.pytorch.org/whl/cpu /source

FROM debian:bookworm-slim
# what open3d and torch load, and a driver for pictures without a screen
RUN apt-get update && apt-get install -y --no-install-recommends python3 \
    libgl1 libegl1 libx11-6 libudev1 libusb-1.0-0 libgomp1 libvulkan1 mesa-vulkan-drivers && \
    rm -rf /var/lib/apt/lists/*
COPY --from=build /opt/sdfsim /opt/sdfsim
ENV PATH=/opt/sdfsim/bin:$PATH
WORKDIR /work
ENTRYPOINT ["sdfsim"]
