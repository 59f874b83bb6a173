// A Hapkit as a device of softfinger: rig `hapkit`, docs/devices/serial.md. For the Hapkit board or an Arduino Uno with
// the same pins. It sends the motor position every millisecond, and applies the last received torque to the motor.
//
//   to the host    A5  counts (int32, lowest byte first)         crc8     6 bytes, 1000 times per second
//   from the host  5A  torque (int16, uN m at the motor)         crc8     4 bytes
//
// crc8: polynomial 0x07, start 0, over all previous bytes. Counts are 0 at the handle position when the board starts.
// WITHOUT A VALID FRAME FOR 50 ms THE MOTOR IS OFF.
//
// Pins, the sensor's jump and the torque of a duty cycle are from the course's sketch (Stanford, T. Morimoto and
// A. Okamura): torque = 0.03 N m duty^2.

const int PWM_PIN = 5;
const int DIRECTION_PIN = 8;
const int SENSOR_PIN = A2;

const long TURN_COUNTS = 980;    // jump of the sensor, which repeats after half a turn of the magnet
const long JUMP_COUNTS = 490;    // larger differences between two readings are jumps
const float FULL_TORQUE = 0.03;  // N m at duty 1
// Timer 0 runs without its divisor of 64, for an inaudible PWM of 62.5 kHz; this also changes micros().
const unsigned long MICROSECOND = 64;
const unsigned long PERIOD = 1000 * MICROSECOND;
const unsigned long SILENCE = 50000 * MICROSECOND;

long counts, last_raw;
uint32_t sent_at, heard_at;
byte frame[4];
byte filled;

byte crc8(const byte *data, int size) {
  byte crc = 0;
  for (int i = 0; i < size; i++) {
    crc ^= data[i];
    for (int bit = 0; bit < 8; bit++) crc = crc & 0x80 ? (byte)((crc << 1) ^ 0x07) : (byte)(crc << 1);
  }
  return crc;
}

void drive(int torque) {
  float duty = sqrt(fabs(torque * 1e-6) / FULL_TORQUE);
  digitalWrite(DIRECTION_PIN, torque > 0 ? HIGH : LOW);
  analogWrite(PWM_PIN, (int)(255 * (duty > 1 ? 1 : duty)));
}

// Read received bytes; skip a damaged frame byte by byte until a valid one.
void listen() {
  while (Serial.available() > 0) {
    frame[filled++] = Serial.read();
    if (filled < 4) continue;
    if (frame[0] == 0x5A && crc8(frame, 3) == frame[3]) {
      drive((int)(int16_t)(frame[1] | (unsigned int)frame[2] << 8));
      heard_at = micros();
      filled = 0;
    } else {
      for (int i = 0; i < 3; i++) frame[i] = frame[i + 1];
      filled = 3;
    }
  }
  if ((uint32_t)(micros() - heard_at) > SILENCE) {
    drive(0);
    heard_at = micros() - SILENCE - 1;  // also after an overflow of micros()
  }
}

void report() {
  long raw = analogRead(SENSOR_PIN);
  long step = raw - last_raw;
  if (step > JUMP_COUNTS) step -= TURN_COUNTS;
  if (step < -JUMP_COUNTS) step += TURN_COUNTS;
  last_raw = raw;
  counts += step;
  byte out[6] = {0xA5, (byte)counts, (byte)(counts >> 8), (byte)(counts >> 16), (byte)(counts >> 24), 0};
  out[5] = crc8(out, 5);
  Serial.write(out, 6);
}

void setup() {
  pinMode(PWM_PIN, OUTPUT);
  pinMode(DIRECTION_PIN, OUTPUT);
  analogWrite(PWM_PIN, 0);
  TCCR0B = (TCCR0B & 0xF8) | 1;
  Serial.begin(115200);
  counts = 0;
  filled = 0;
  last_raw = analogRead(SENSOR_PIN);
  sent_at = micros();
  heard_at = sent_at - SILENCE - 1;
}

void loop() {
  listen();
  if ((uint32_t)(micros() - sent_at) >= PERIOD) {
    sent_at += PERIOD;
    report();
  }
}
