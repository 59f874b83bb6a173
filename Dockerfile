# softfinger with compiled kernels. Operation in real time: docs/operate/docker.md
#
#   docker build -t softfinger .
#   docker build -t softfinger --build-arg CPU_NAME=cortex-a76 .     # for another processor: see CPU_NAME

FROM python:3.12-slim-bookworm AS builder
SHELL ["/bin/bash", "-eu", "-o", "pipefail", "-c"]
ENV PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_CACHE_DIR=1 PIP_ROOT_USER_ACTION=ignore
WORKDIR /build/src

# Verifies the hash of each wheel. Later steps install only from this folder.
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

# Compile kernels for a named processor instead of the builder's. The name is LLVM's; x86-64-v3 is any x86 with AVX2
# (since 2013). Features are empty because numba would add the builder's. On another machine, kernels with these
# features are not found or do not run.
ARG CPU_NAME=x86-64-v3
ENV NUMBA_CPU_NAME=${CPU_NAME} NUMBA_CPU_FEATURES="" SOFTFINGER_CACHE_DIR=/var/cache/softfinger
RUN /opt/softfinger/bin/softfinger warmup


FROM python:3.12-slim-bookworm
SHELL ["/bin/bash", "-eu", "-o", "pipefail", "-c"]
# libusb for makers' libraries (pyusb and hidapi include it). Not pinned: Debian has one version per release, and each
# point release removes the previous one, so a pinned version would only break the build.
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install --yes --no-install-recommends libusb-1.0-0 \
    && rm -rf /var/lib/apt/lists/* \
    && useradd --uid 10001 --user-group --create-home --home-dir /var/lib/softfinger softfinger

COPY --from=builder /opt/softfinger /opt/softfinger
# Owned by the user: kernels are only loaded from the user's folders, and kernels of other scenes are added.
COPY --from=builder --chown=10001:10001 /var/cache/softfinger /var/cache/softfinger

ARG CPU_NAME=x86-64-v3
ENV NUMBA_CPU_NAME=${CPU_NAME} NUMBA_CPU_FEATURES="" SOFTFINGER_CACHE_DIR=/var/cache/softfinger \
    PATH=/opt/softfinger/bin:${PATH} PYTHONUNBUFFERED=1
USER 10001:10001
WORKDIR /var/lib/softfinger
EXPOSE 5555

# Healthy: the health message arrives, which is sent once per second. A rig with another telemetry endpoint
# requires --no-healthcheck or another --health-cmd.
HEALTHCHECK --interval=30s --timeout=10s --start-period=30s CMD ["python", "-c", "import zmq; s = zmq.Context().socket(zmq.SUB); s.linger = 0; s.rcvtimeo = 5000; s.subscribe(b'health'); s.connect('tcp://127.0.0.1:5555'); s.recv_multipart()"]

ENTRYPOINT ["softfinger"]
CMD ["run"]
