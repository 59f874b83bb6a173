# softfinger with its kernels compiled ahead. docs/operate/docker.md says how to run it in real time.
#
#   docker build -t softfinger .
#   docker build -t softfinger --build-arg CPU_NAME=cortex-a76 .     # for another processor, see CPU_NAME

FROM python:3.12-slim-bookworm AS builder
SHELL ["/bin/bash", "-eu", "-o", "pipefail", "-c"]
ENV PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_CACHE_DIR=1 PIP_ROOT_USER_ACTION=ignore
WORKDIR /build/src

# Every wheel is checked against its hash here; what follows installs from this folder alone.
COPY constraints.txt ./
RUN pip download --quiet --require-hashes --only-binary :all: --dest /build/wheels -r constraints.txt
RUN python -m venv /build/venv \
    && /build/venv/bin/pip install --quiet --no-index --find-links /build/wheels build hatchling

COPY LICENSE pyproject.toml ./
COPY .ci/package_page.md .ci/
COPY config config
COPY drivers drivers
COPY proxy proxy
COPY server server
COPY tools tools
RUN /build/venv/bin/python -m build --wheel --no-isolation --outdir /build/wheels . \
    && python -m venv --without-pip /opt/softfinger \
    && pip --python /opt/softfinger/bin/python install --quiet --no-index --find-links /build/wheels /build/wheels/softfinger-*.whl

# Kernels for one named processor rather than for the builder's: an LLVM name; x86-64-v3 is any x86
# with AVX2 (2013 on). The features are emptied because numba would add the builder's own to the name,
# and a kernel built with them is not found, or does not run, on another machine.
ARG CPU_NAME=x86-64-v3
ENV NUMBA_CPU_NAME=${CPU_NAME} NUMBA_CPU_FEATURES="" SOFTFINGER_CACHE_DIR=/var/cache/softfinger
RUN /opt/softfinger/bin/softfinger warmup


FROM python:3.12-slim-bookworm
SHELL ["/bin/bash", "-eu", "-o", "pipefail", "-c"]
# libusb for makers' libraries (pyusb and hidapi have their own). Unpinned: Debian keeps one version of it per release and
# removes the old one at each point release, which would break the build and protect nothing.
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install --yes --no-install-recommends libusb-1.0-0 \
    && rm -rf /var/lib/apt/lists/* \
    && useradd --uid 10001 --user-group --create-home --home-dir /var/lib/softfinger softfinger

COPY --from=builder /opt/softfinger /opt/softfinger
# Owned by the user: kernels are loaded from a folder of one's own alone, and those of other scenes are added.
COPY --from=builder --chown=10001:10001 /var/cache/softfinger /var/cache/softfinger

ARG CPU_NAME=x86-64-v3
ENV NUMBA_CPU_NAME=${CPU_NAME} NUMBA_CPU_FEATURES="" SOFTFINGER_CACHE_DIR=/var/cache/softfinger \
    PATH=/opt/softfinger/bin:${PATH} PYTHONUNBUFFERED=1
USER 10001:10001
WORKDIR /var/lib/softfinger
EXPOSE 5555

# Alive means that the once-a-second health message arrives. A rig with another telemetry endpoint
# needs --no-healthcheck or its own --health-cmd.
HEALTHCHECK --interval=30s --timeout=10s --start-period=30s CMD ["python", "-c", "import zmq; s = zmq.Context().socket(zmq.SUB); s.linger = 0; s.rcvtimeo = 5000; s.subscribe(b'health'); s.connect('tcp://127.0.0.1:5555'); s.recv_multipart()"]

ENTRYPOINT ["softfinger"]
CMD ["run"]
