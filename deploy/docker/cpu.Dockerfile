# The service on CPUs, with the bundled checkpoint. From the repository's root:
#   docker build -f deploy/docker/cpu.Dockerfile -t looktwice:0.1.0-cpu .
# With Ray: --build-arg RAY=yes -t looktwice:0.1.0-cpu-ray
#   docker run --rm --read-only --tmpfs /tmp -e LOOKTWICE_OPEN=true -p 127.0.0.1:8000:8000 looktwice:0.1.0-cpu
ARG PYTHON=3.11.14-slim-bookworm

FROM python:${PYTHON} AS build
# Not empty: with Ray, for deploy/ray. Ray Serve brings HAProxy along, which is under the GPL.
ARG RAY=""
ENV PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_CACHE_DIR=1
WORKDIR /source
RUN python -m venv /opt/looktwice
COPY constraints.txt ./
# torch first and alone: its layer, by far the largest, stays until a pin changes.
RUN /opt/looktwice/bin/pip install -c constraints.txt \
    --extra-index-url https://download.pytorch.org/whl/cpu torch==2.13.0+cpu
COPY . .
RUN pip wheel --no-deps --wheel-dir /wheels . \
    && /opt/looktwice/bin/pip install -c constraints.txt "$(ls /wheels/looktwice-*.whl)[otel,serve${RAY:+,ray}]"

FROM python:${PYTHON}
ARG RAY=""
LABEL org.opencontainers.image.title="LookTwice" \
    org.opencontainers.image.description="Planning for driving models that look twice before they act, on CPUs" \
    org.opencontainers.image.licenses="Apache-2.0${RAY:+ AND GPL-2.0-or-later}"
COPY --from=build /opt/looktwice /opt/looktwice
# Whatever a library wants to keep goes below /tmp, the one place that can be written.
ENV PATH=/opt/looktwice/bin:${PATH} \
    HF_HUB_OFFLINE=1 \
    HOME=/tmp \
    MPLCONFIGDIR=/tmp/matplotlib \
    PYTHONDONTWRITEBYTECODE=1 \
    PYTHONUNBUFFERED=1
WORKDIR /tmp
USER 10001:10001
EXPOSE 8000
STOPSIGNAL SIGTERM
HEALTHCHECK --interval=10s --timeout=3s --start-period=60s --retries=3 \
    CMD ["python", "-c", "from urllib.request import urlopen; urlopen('http://127.0.0.1:8000/healthz', timeout=2)"]
ENTRYPOINT ["looktwice"]
CMD ["serve", "--host", "0.0.0.0", "--port", "8000"]
