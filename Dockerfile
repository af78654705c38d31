# Images for the CPU, and with --target cuda for NVIDIA GPUs:
#
#     docker build --tag splatpilot .
#     mkdir --parents out
#     docker run --rm --user "$(id -u):$(id -g)" --env HOME=/tmp --volume "$PWD/out:/home/pilot/out" splatpilot \
#         fly --out out/fly
# hadolint global ignore=DL3008
FROM python:3.12-slim-bookworm AS wheel
RUN apt-get update \
  && apt-get install --yes --no-install-recommends g++ \
  && rm -rf /var/lib/apt/lists/*
WORKDIR /source
COPY CMakeLists.txt LICENSE README.md pyproject.toml ./
COPY native native
COPY splatpilot splatpilot
COPY systems systems
COPY diagrams diagrams
COPY training training
COPY analysis analysis
RUN pip wheel --no-cache-dir --no-deps --wheel-dir /wheels .

# gsplat compiles its kernels on first use, by CUDA's compiler.
FROM nvidia/cuda:12.8.1-devel-ubuntu24.04 AS cuda
RUN apt-get update \
  && apt-get install --yes --no-install-recommends \
    g++ libegl1 libglib2.0-0t64 ninja-build python3-dev python3-venv \
  && rm -rf /var/lib/apt/lists/* \
  && python3 -m venv /opt/splatpilot \
  && useradd --create-home --uid 1500 pilot
ENV PATH=/opt/splatpilot/bin:$PATH
RUN --mount=type=bind,from=wheel,source=/wheels,target=/wheels \
  pip install --no-cache-dir "$(ls /wheels/*.whl)[cuda,train]"
USER 1500
WORKDIR /home/pilot
ENTRYPOINT ["splatpilot"]

FROM python:3.12-slim-bookworm AS cpu
RUN apt-get update \
  && apt-get install --yes --no-install-recommends libegl1 libglib2.0-0 \
  && rm -rf /var/lib/apt/lists/* \
  && useradd --create-home --uid 1500 pilot
RUN --mount=type=bind,from=wheel,source=/wheels,target=/wheels \
  pip install --no-cache-dir --only-binary :all: /wheels/*.whl
USER 1500
WORKDIR /home/pilot
ENTRYPOINT ["splatpilot"]
