# rotorwatch with its web page, the PostgreSQL driver and a Dask client. Build: docker build -t rotorwatch .
# Packages are those of the lock files, each checked by its hash. The first stage has a C compiler, which makes the machine code.
FROM python:3.13-bookworm AS build
WORKDIR /src
COPY lock/build.txt lock/image.txt lock/
RUN python -m venv /opt/build && \
    /opt/build/bin/pip install --no-cache-dir --require-hashes --only-binary :all: -r lock/build.txt
RUN python -m venv /opt/rotorwatch && \
    /opt/rotorwatch/bin/pip install --no-cache-dir --require-hashes --only-binary :all: -r lock/image.txt
COPY pyproject.toml hatch_build.py README.md LICENSE ./
COPY src src
RUN ROTORWATCH_SHIP=portable /opt/build/bin/pip wheel --no-deps --no-build-isolation --wheel-dir /opt/wheels . && \
    /opt/rotorwatch/bin/pip install --no-cache-dir --no-deps --no-index /opt/wheels/rotorwatch-*-linux_*.whl && \
    /opt/rotorwatch/bin/rotorwatch --version

FROM python:3.13-slim-bookworm
COPY --from=build /opt/rotorwatch /opt/rotorwatch
RUN useradd --create-home --uid 10001 rotorwatch && \
    install -d -o rotorwatch -g rotorwatch /data
ENV PATH=/opt/rotorwatch/bin:$PATH \
    XDG_CACHE_HOME=/data/cache
USER 10001
WORKDIR /data
VOLUME /data
EXPOSE 8000
ENTRYPOINT ["rotorwatch"]
CMD ["--help"]
