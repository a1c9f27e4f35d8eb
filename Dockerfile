# snowsplat in a container, on the CPU or on an NVIDIA GPU: docs/installation.md tells how to build and use it.
#
# The default target has the CPU build of PyTorch. The target `gpu` has the CUDA build; the host needs an
# NVIDIA driver and the NVIDIA Container Toolkit.

ARG BASE=docker.io/library/debian:bookworm-slim

# The compiler is needed for the wheel only, and is not in the images.
FROM ${BASE} AS wheel
RUN apt-get update && apt-get install -y --no-install-recommends g++ python3-venv
RUN python3 -m venv /opt/build
COPY . /source
RUN /opt/build/bin/pip wheel --no-deps --wheel-dir /wheel /source

FROM ${BASE} AS python
RUN apt-get update && apt-get install -y --no-install-recommends python3-venv && \
    rm -rf /var/lib/apt/lists/* && python3 -m venv /opt/snowsplat
ENV PATH=/opt/snowsplat/bin:$PATH
# Not root: what parses strangers' photos has no rights in the container. `docker run --user` names the
# user whom the files belong to; HOME is writable for all users.
RUN useradd --uid 1000 --create-home snowsplat && chmod 777 /home/snowsplat
ENV HOME=/home/snowsplat
WORKDIR /work
ENTRYPOINT ["snowsplat"]
CMD ["--help"]

FROM python AS gpu
RUN --mount=type=bind,from=wheel,source=/wheel,target=/wheel \
    pip install --no-cache-dir /wheel/snowsplat-*.whl
USER snowsplat

FROM python AS cpu
# Empty: the default build of PyTorch.
ARG TORCH_BACKEND=cpu
RUN --mount=type=bind,from=wheel,source=/wheel,target=/wheel \
    pip install --no-cache-dir uv && \
    uv pip install --no-cache --python /opt/snowsplat/bin/python \
        ${TORCH_BACKEND:+--torch-backend=${TORCH_BACKEND}} /wheel/snowsplat-*.whl && \
    pip uninstall --yes uv
USER snowsplat
