# Images with every command of gsgan, for the CPU or for CUDA:
#   docker build -t gsgan .
#   docker build -t gsgan:cuda --build-arg BASE=nvidia/cuda:12.8.1-devel-ubuntu24.04 --build-arg TORCH=2.8.0+cu128 \
#     --build-arg VISION=0.23.0+cu128 --build-arg WHEELS=cu128 --build-arg EXTRAS=render,export,view,gltf,gsplat .
#   docker run --rm -v "$PWD:/work" gsgan python -m gsgan.train experiment=demo
#   docker run --rm --gpus all -v "$PWD:/work" gsgan:cuda python -m gsgan.train experiment=demo

# Debian with Python, or one of NVIDIA's with nvcc, which compiles gsplat.
ARG BASE=python:3.12-slim-bookworm
FROM ${BASE}

# Versions of torch and torchvision, and the folder of their wheels.
ARG TORCH=2.13.0
ARG VISION=0.28.0
ARG WHEELS=cpu
ARG EXTRAS=render,export,view,gltf

# A compiler for the rasteriser; Python where the base has none.
RUN apt-get update \
    && apt-get install -y --no-install-recommends g++ \
    && (command -v python3 || apt-get install -y --no-install-recommends python3-dev python3-venv) \
    && rm -rf /var/lib/apt/lists/*
RUN python3 -m venv /opt/venv
ENV PATH=/opt/venv/bin:$PATH

# torch changes less often than gsgan: its layer stays.
RUN pip install --no-cache-dir --extra-index-url https://download.pytorch.org/whl/${WHEELS} \
    torch==${TORCH} torchvision==${VISION}
WORKDIR /opt/gsgan
COPY pyproject.toml README.md LICENSE hatch_build.py ./
COPY conf conf
COPY src src
RUN pip install --no-cache-dir ".[${EXTRAS}]"

# The rasteriser is compiled once, here. Files of the user are mounted at /work.
RUN python -c "from gsgan.splat import native; assert native.available(), native.why_not()"
WORKDIR /work
CMD ["python", "-m", "gsgan"]
