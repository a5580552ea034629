# The service on NVIDIA GPUs, with the torch engine and vLLM. From the repository's root:
#   docker build -f deploy/docker/cuda.Dockerfile -t looktwice:0.1.0-cuda .
# With Ray: --build-arg RAY=yes -t looktwice:0.1.0-cuda-ray
#   docker run --rm --gpus all --read-only --tmpfs /tmp:exec -e LOOKTWICE_OPEN=true -p 127.0.0.1:8000:8000 \
#     looktwice:0.1.0-cuda serve --host 0.0.0.0 --device cuda
# CUDA comes with torch's wheels; the host has the driver and the NVIDIA container toolkit.
ARG PYTHON=3.11.14-slim-bookworm

FROM python:${PYTHON} AS build
# Not empty: with Ray, for deploy/ray. Ray Serve brings HAProxy along, which is under the GPL.
ARG RAY=""
ENV PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_CACHE_DIR=1
WORKDIR /source
RUN python -m venv /opt/looktwice
# Pins of their own: vLLM holds several packages back.
COPY deploy/docker/cuda.constraints.txt ./
# torch and vLLM first and alone: their layer, by far the largest, stays until a pin changes.
RUN /opt/looktwice/bin/pip install -c cuda.constraints.txt torch==2.13.0 vllm==0.32.0
COPY . .
RUN pip wheel --no-deps --wheel-dir /wheels . \
    && /opt/looktwice/bin/pip install -c deploy/docker/cuda.constraints.txt \
    "$(ls /wheels/looktwice-*.whl)[otel,serve,vllm${RAY:+,ray}]"

FROM python:${PYTHON}
ARG RAY=""
LABEL org.opencontainers.image.title="LookTwice" \
    org.opencontainers.image.description="Planning for driving models that look twice before they act, on GPUs" \
    org.opencontainers.image.licenses="Apache-2.0${RAY:+ AND GPL-2.0-or-later}"
# Triton compiles small C programs when a kernel is first used.
RUN apt-get update \
    && apt-get install -y --no-install-recommends gcc=4:12.2.0-3 libc6-dev=2.36-9+deb12u* \
    && rm -rf /var/lib/apt/lists/*
COPY --from=build /opt/looktwice /opt/looktwice
# Whatever a library wants to keep goes below /tmp, the one place that can be written.
ENV PATH=/opt/looktwice/bin:${PATH} \
    HF_HUB_OFFLINE=1 \
    HOME=/tmp \
    MPLCONFIGDIR=/tmp/matplotlib \
    NVIDIA_DRIVER_CAPABILITIES=compute,utility \
    NVIDIA_VISIBLE_DEVICES=all \
    PYTHONDONTWRITEBYTECODE=1 \
    PYTHONUNBUFFERED=1 \
    VLLM_NO_USAGE_STATS=1
WORKDIR /tmp
USER 10001:10001
EXPOSE 8000
STOPSIGNAL SIGTERM
HEALTHCHECK --interval=10s --timeout=3s --start-period=20m --retries=3 \
    CMD ["python", "-c", "from urllib.request import urlopen; urlopen('http://127.0.0.1:8000/healthz', timeout=2)"]
ENTRYPOINT ["looktwice"]
CMD ["serve", "--host", "0.0.0.0", "--port", "8000", "--device", "cuda"]
